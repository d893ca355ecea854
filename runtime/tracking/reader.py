"""The thread that reads a source of frames."""

from __future__ import annotations

import threading

from modsoft.runtime.tracking.frame import FrameError, LatestFrame, Source

CLOSE_WAIT_S = 0.5  # a client that waits for a mute device is not waited for any longer


class Reader:
    """Reads a source into a `LatestFrame` from a daemon thread, which also closes it. The caller opens the source and
    handles the errors of opening it."""

    def __init__(self, source: Source, latest: LatestFrame):
        self._latest = latest
        self._source = source
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tracker", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    frame = self._source.read()
                except FrameError as error:
                    self._latest.put_error(error)
                    continue
                if frame is not None:
                    self._latest.put(frame)
        except Exception as error:  # noqa: BLE001 - any error of a driver ends the run, with venting
            self._latest.error = error
        finally:
            try:
                self._source.close()
            except Exception as error:  # noqa: BLE001 - the run is over, or lost already
                self._latest.error = self._latest.error or error

    def close(self) -> None:
        """Ends the reading. A thread that waits for a mute device ends with the process."""
        self._stop.set()
        self._thread.join(CLOSE_WAIT_S)
