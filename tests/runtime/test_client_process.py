"""The process of a tracker's client: frames, errors, death, silence and nonsense, and its own end."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tracker_clients

from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.tracking import client_process, messages
from modsoft.runtime.tracking.client_process import ClientProcess
from modsoft.runtime.tracking.frame import FrameError

POSIX = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture
def opened(tmp_path):
    sources = []

    def open_client(client=tracker_clients.once, **options):
        sources.append(ClientProcess(partial(client, tmp_path, **options), "tracker at x"))
        return sources[-1]

    yield open_client
    for source in sources:
        source.close()


def frames_and_errors(source, until, seconds=20.0):
    """All frames and texts of errors until `until(frames, errors)`."""
    frames, errors, end_s = [], [], time.monotonic() + seconds
    while not until(frames, errors):
        assert time.monotonic() < end_s, errors
        try:
            frame = source.read()
        except FrameError as error:
            errors.append(str(error))
        else:
            frames += [] if frame is None else [frame]
    return frames, errors


def test_frames_and_name_of_the_device_arrive_whole(opened):
    source = opened(frames=100)
    frames, errors = frames_and_errors(source, lambda frames, errors: len(frames) == 5)
    assert source.device == "test tracker"
    assert [frame.device_frame for frame in frames] == [1, 2, 3, 4, 5]
    assert errors == []
    frame = frames[-1]
    assert frame.monotonic_s <= frame.answered_s <= time.monotonic()
    assert (frame.port_status, frame.device_hz, frame.valid.tolist()) == ((0x31,) * 4, 500.0, [True] * 4)
    np.testing.assert_array_equal(frame.poses, np.tile(np.eye(4), (4, 1, 1)))


@pytest.mark.parametrize(
    ("then", "error"),
    [
        pytest.param("crash", "ended (SIGSEGV)", marks=POSIX),
        ("end", "ended (exit code 3)"),
        ("hang", "sent nothing for 1."),
        ("nonsense", "are not a message"),
        ("error", "cable"),
    ],
)
def test_lost_client_is_started_again_and_frames_continue(then, error, opened):
    """The second client counts from 0 again; the numbers of the frames go on."""
    source = opened(frames=5, then=then, first=1000)
    frames, errors = frames_and_errors(source, lambda frames, errors: errors and len(frames) >= 8)
    assert error in errors[0]
    numbers = [frame.device_frame for frame in frames]
    assert numbers == sorted(set(numbers))
    assert numbers[:5] == [1001, 1002, 1003, 1004, 1005]


def test_damaged_replies_do_not_restart_the_client(opened, tmp_path):
    source = opened(frames=5, then="damaged")
    _, errors = frames_and_errors(source, lambda frames, errors: len(frames) >= 30 and len(errors) >= 3)
    assert set(errors) == {"wrong checksum"}
    assert not (tmp_path / "closed").exists()


@pytest.mark.parametrize(
    ("client", "error", "text"),
    [
        (tracker_clients.absent, DeviceAbsent, "^no tracker at /dev/none$"),
        (tracker_clients.unusable, UsageError, "^no tools given$"),
        (tracker_clients.bug, DeviceAbsent, "^ZeroDivisionError: a bug$"),
        pytest.param(tracker_clients.crash, DeviceAbsent, r"^tracker at x: .* ended \(SIGSEGV\); ", marks=POSIX),
    ],
)
def test_error_of_opening_is_the_callers(client, error, text):
    with pytest.raises(error, match=text):
        ClientProcess(client, "tracker at x")


def test_client_closes_its_tracker_and_ends(opened, tmp_path):
    source = opened(frames=10**9)
    frames_and_errors(source, lambda frames, errors: frames)
    process = source._process
    source.close()
    assert (tmp_path / "closed").exists()
    assert not process.is_alive()
    source.close()


def test_hanging_client_is_killed_at_the_end(opened):
    source = opened(frames=1, then="hang")
    frames_and_errors(source, lambda frames, errors: frames)
    process, began_s = source._process, time.monotonic()
    source.close()
    assert not process.is_alive()
    assert time.monotonic() - began_s < 2.0


def test_mute_client_is_given_up(opened, monkeypatch):
    monkeypatch.setattr(client_process, "CONNECT_S", -1.0)
    with pytest.raises(DeviceAbsent, match="tracker at x: the tracker's client sent nothing"):
        opened()


@POSIX
def test_client_ignores_ctrl_c_and_a_closed_terminal(opened, tmp_path):
    source = opened(frames=10**9)
    frames_and_errors(source, lambda frames, errors: frames)
    for number in (signal.SIGINT, signal.SIGHUP):
        os.kill(source._process.pid, number)
    _, errors = frames_and_errors(source, lambda frames, errors: len(frames) > 20)
    assert errors == []


def test_output_of_the_client_is_discarded(opened, capfd):
    frames_and_errors(opened(tracker_clients.printing), lambda frames, errors: frames)
    assert capfd.readouterr().out == ""


OWNER = """
import sys, time
from functools import partial
import tracker_clients
from modsoft.runtime.tracking.client_process import ClientProcess
if __name__ == "__main__":
    source = ClientProcess(partial(tracker_clients.once, sys.argv[1], frames=5, then="hang"), "x")
    print("open", flush=True)
    time.sleep(60)
"""


@POSIX
def test_client_ends_with_the_runtime(tmp_path):
    """Also while it is blocked, and the runtime was killed."""
    script = tmp_path / "owner.py"
    script.write_text(OWNER)
    shared = str(Path(tracker_clients.__file__).parent)
    owner = subprocess.Popen(
        [sys.executable, script, tmp_path], stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": shared}
    )
    assert owner.stdout.readline() == b"open\n"
    pid = int((tmp_path / "pid").read_text())
    owner.kill()
    owner.wait()
    owner.stdout.close()
    end_s = time.monotonic() + 10
    while is_alive(pid):
        assert time.monotonic() < end_s
        time.sleep(0.01)


def is_alive(pid):
    """A process that has ended may wait as a zombie for its new parent."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except ProcessLookupError:
        return False
    except FileNotFoundError:  # gone meanwhile, or a system without /proc
        return Path("/proc").exists() is False


# ---- The messages


FRAME = messages.Frame(1, 1.0, 1.0, bytes(128 * 2), [True, True], [0.1, 0.1], [0x31, 0x31], 60.0)


@pytest.mark.parametrize(
    "parts",
    [
        {"poses": bytes(128)},
        {"valid": [True]},
        {"quality": [0.1]},
        {"port_status": [1]},
        {"monotonic_s": 10.1},
        {"monotonic_s": float("nan")},
    ],
)
def test_frame_whose_parts_do_not_fit_is_refused(parts):
    import msgspec

    with pytest.raises(FrameError, match="the tracker's client sent a frame"):
        messages.to_frame(msgspec.structs.replace(FRAME, **parts), 10.0)


@pytest.mark.parametrize("seed", range(20))
def test_damaged_message_is_an_error_or_a_message(seed):
    rng = np.random.default_rng(seed)
    for _ in range(200):
        data = bytearray(messages.encode(FRAME))
        for at in rng.integers(len(data), size=3):
            data[at] = rng.integers(256)
        try:
            message = messages.decode(bytes(data))
            if isinstance(message, messages.Frame):
                messages.to_frame(message, 10.0)
        except FrameError:
            pass
