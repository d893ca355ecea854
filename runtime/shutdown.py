"""The end of a run: venting first, then the log, then the report to the operator."""

from __future__ import annotations

import time

from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import VentMode
from modsoft.runtime.errors import INTERNAL_EXIT_CODE, LostInRun, ModsoftError, Tripped
from modsoft.runtime.log import RunLog
from modsoft.runtime.log_record import EndRecord
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Paused, StopKey
from modsoft.runtime.terminal import say
from modsoft.runtime.tracking.frame import LatestFrame


def finish(
    board: Board | None, log: RunLog, statistics: TickStatistics, frames: LatestFrame, error: BaseException | None
) -> None:
    """Vents, closes the log, reports the run, and raises the error that ended it, if any. `board`: None in a dry run;
    `error`: what the loop raised."""
    began_ns, vented_ns = time.monotonic_ns(), None
    vented, residual_bar = False, dict[int, float]()
    if board is not None:
        try:
            vented = board.vent(VentMode.DUMP if isinstance(error, StopKey) else VentMode.RAMP)
            vented_ns = time.monotonic_ns() if vented else None
            residual_bar = board.residual_pressures_bar() if vented else {}
        except Exception as failure:  # noqa: BLE001 - the log must still be closed; the board's own timer vents
            error = error or failure
        if not vented and (error is None or isinstance(error, Paused)):
            what = "the task is done" if error is None else "the run is paused"
            error = LostInRun(f"{what}, but the board did not confirm the venting; look at the pressures")
    if residual_bar:
        error = _stuck(residual_bar, error)
    code, reason = 0, "done"
    if error is not None:
        code = error.exit_code if isinstance(error, ModsoftError) else INTERNAL_EXIT_CODE
        reason = str(error) or type(error).__name__
    log.put(EndRecord(began_ns, code, reason, vented, vented_ns, residual_bar))
    if board is None:
        outcome = "dry run, no valve was used"
    else:
        outcome = (
            "yes, confirmed by the board"
            if vented
            else "NOT KNOWN, the board did not confirm it; look at the pressures"
        )
    for line in [*statistics.summary(), f"valves vented: {outcome}"]:  # before the log: a disk may hang
        say(line)
    figures = {"figures": statistics.figures(), "tracker": dict(frames.counts), "vented": vented}
    log.close(code, reason, {**figures, "connection": None if board is None else board.statistics})
    say(f"log: {log.folder}")
    if log.trouble:
        say(f"log: {log.trouble}")
    if error is not None:
        raise error


def _stuck(residual_bar: dict[int, float], error: BaseException | None) -> Tripped:
    """The error for pressures that remain after the venting."""
    pressures = ", ".join(f"channel {channel} still measures {bar:.2f} bar" for channel, bar in residual_bar.items())
    before = f" (the run ended before that: {str(error) or type(error).__name__})" if error is not None else ""
    advice = "shut off the air, then look at that valve and its sensor"
    stuck = Tripped(f"the valves are commanded to 0, but {pressures}: {advice}{before}")
    stuck.__cause__ = error
    return stuck
