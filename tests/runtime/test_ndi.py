"""The NDI client without a device: strict replies, errors, pace, frame rate, and tools of five degrees of freedom."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime.errors import DeviceAbsent
from modsoft.runtime.tracking import ndi, tx_reply
from modsoft.runtime.tracking.frame import FrameError
from modsoft.runtime.tracking.frame_rate import FrameRate

HANDLES = [10, 11, 12, 13]
TRANSFORM = "+10000+00000+00000+00000" + "+000123-000568-140013" + "+01000"


def record(handle, number, transform=TRANSFORM, status=0x31):
    return f"{handle:02X}{transform}{status:08X}{number:08X}\n"


def reply(number=5, count=4, **changes):
    return f"{count:02X}" + "".join(record(handle, number, **changes) for handle in HANDLES[:count]) + "0000"


def parsed(text, handles=HANDLES):
    return tx_reply.parse(text, handles, 1.0, 1.02, 60.0)


# ---- The reply


def test_reply_is_parsed():
    frame = parsed(reply(number=0x1234, status=0xB1))
    assert (frame.device_frame, frame.monotonic_s, frame.answered_s, frame.device_hz) == (0x1234, 1.0, 1.02, 60.0)
    assert frame.valid.tolist() == [True] * 4
    assert frame.port_status == (0xB1,) * 4
    np.testing.assert_allclose(frame.quality, 0.1)
    np.testing.assert_allclose(frame.poses[2, :3, 3], [1.23, -5.68, -1400.13])
    np.testing.assert_array_equal(frame.poses[2, :3, :3], np.eye(3))


@pytest.mark.parametrize("word", ["MISSING", "DISABLED"])
def test_missing_tool_is_not_valid(word):
    text = "02" + record(10, 7) + record(11, 7, word) + "0000"
    frame = parsed(text, [10, 11])
    assert frame.valid.tolist() == [True, False]
    assert np.isnan(frame.poses[1, :3]).all()
    assert np.isnan(frame.quality[1])


def test_tool_left_out_unoccupied_or_of_an_old_frame_is_not_valid():
    text = "03" + record(10, 100) + record(11, 93) + "0CUNOCCUPIED\n" + "0000"
    frame = parsed(text)
    assert frame.device_frame == 100
    assert frame.valid.tolist() == [True, False, False, False]


def test_poses_are_those_of_the_client():
    from sksurgerycore.algorithms.tracking_smoothing import quaternion_to_matrix

    rng = np.random.default_rng(3)
    for quaternion in rng.normal(size=(50, 4)):
        quaternion /= np.linalg.norm(quaternion)
        pose = np.array(tx_reply.matrix(*quaternion, 1.0, 2.0, 3.0))
        np.testing.assert_allclose(pose[:3, :3], quaternion_to_matrix(quaternion), atol=1e-15)
        np.testing.assert_array_equal(pose[:, 3], [1.0, 2.0, 3.0, 1.0])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "OKAY",
        "000000",
        reply()[:-1],
        reply() + "0",
        reply().replace("\n", "", 1),
        "05" + reply()[2:],
        "04" + 4 * record(10, 5) + "0000",
        reply(transform=TRANSFORM.replace("+10000", "+09000")),
        reply(transform=TRANSFORM.replace("+10000", "+1OOOO")),
        reply(transform=TRANSFORM.replace("+10000", "+١٠٠٠٠")),
        "01" + record(99, 5) + "0000",
    ],
)
def test_invalid_reply_gives_no_frame(text):
    with pytest.raises(FrameError, match="reply"):
        parsed(text)


@given(st.data())
def test_changed_character_is_an_error_or_stays_in_its_field(data):
    """The checksum finds a changed digit. What has the form of a reply has values of their form."""
    text = reply()
    at = data.draw(st.integers(0, len(text) - 1))
    changed = text[:at] + data.draw(st.characters()) + text[at + 1 :]
    try:
        frame = parsed(changed)
    except FrameError:
        return
    assert frame.poses.shape == (4, 4, 4)
    assert np.isfinite(frame.poses[frame.valid]).all()


# ---- The client


class Client:
    """Replies to TX, or raises, call by call."""

    version = "Polaris Spectra Control Firmware\nNDI S/N: P7-00123\nFreeze Tag: Polaris Spectra Rev 009\n(C) NDI\n"

    def __init__(self, replies):
        self.replies = iter(replies)

    def get_tool_descriptions(self):
        return [HANDLES, []]

    def tx(self):
        answer = next(self.replies)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def error_code(self):
        return 0x0104

    def close(self):
        pass


class BadLine(Client):
    def error_code(self):
        return ndi.BAD_CRC


def connected(monkeypatch, tmp_path, client, kind="polaris", **options):
    tools = [tmp_path / f"{n}.rom" for n in range(4)]
    for path in tools:
        path.touch()
    monkeypatch.setattr(ndi, "_connected", lambda *settings: client)
    clock = [0.0]
    source = ndi.NDI(
        kind, "port", tools, 4, now=lambda: clock[0], wait=lambda s: clock.__setitem__(0, clock[0] + s), **options
    )
    return source, clock


CRC_ERROR = OSError("Error 0x0100: Bad CRC on reply\n   and more")


def test_any_number_of_wrong_checksums_is_overcome(monkeypatch, tmp_path):
    source, _ = connected(monkeypatch, tmp_path, BadLine([reply(5), *[CRC_ERROR] * 50, reply(6)]))
    assert source.read().device_frame == 5
    for _ in range(50):
        with pytest.raises(FrameError, match=r"^Error 0x0100: Bad CRC on reply$"):
            source.read()
    assert source.read().device_frame == 6


def test_device_is_described_by_its_reply_to_ver(monkeypatch, tmp_path):
    source, _ = connected(monkeypatch, tmp_path, Client([]))
    assert source.device == "Polaris Spectra Rev 009, serial number P7-00123"
    assert ndi.described("OKAY\n:\nFreeze Tag:\n") == ""


def test_three_other_errors_in_a_row_lose_the_tracker(monkeypatch, tmp_path):
    error = OSError("Error 0x0104: write")
    source, _ = connected(monkeypatch, tmp_path, Client([error, error, reply(5), error, error, error]))
    for _ in range(2):
        with pytest.raises(FrameError, match="tracker at port"):
            source.read()
    assert source.read().device_frame == 5
    for expected in (FrameError, FrameError, DeviceAbsent):
        with pytest.raises(expected, match=r"tracker at port: Error 0x0104: write$"):
            source.read()


def test_reply_that_is_not_text_gives_no_frame(monkeypatch, tmp_path):
    error = UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid")
    source, _ = connected(monkeypatch, tmp_path, Client([error]))
    with pytest.raises(FrameError, match="not text"):
        source.read()


def test_frames_are_requested_60_times_a_second(monkeypatch, tmp_path):
    source, clock = connected(monkeypatch, tmp_path, Client([reply(n) for n in range(1, 100)]))
    for _ in range(61):
        source.read()
    assert clock[0] == pytest.approx(1.0)


def test_repeated_frame_is_none(monkeypatch, tmp_path):
    source, _ = connected(monkeypatch, tmp_path, Client([reply(5), reply(5), reply(6)]))
    assert [frame and frame.device_frame for frame in (source.read(), source.read(), source.read())] == [5, None, 6]


def test_wrong_number_of_tools_is_one_line(monkeypatch, tmp_path):
    client = Client([])
    client.get_tool_descriptions = lambda: [HANDLES[:3], []]
    with pytest.raises(DeviceAbsent, match="3 tools, the robot needs 4"):
        connected(monkeypatch, tmp_path, client)


def turned(roll):
    """A transform with a rotation about the tool's x axis, with or without one about z."""
    return f"+09{'798' if roll else '800'}+01990+00000{'+00200' if roll else '+00000'}" + TRANSFORM[24:]


def aurora(number, five_dof):
    text = "".join(record(handle, number, turned(roll=handle != five_dof)) for handle in HANDLES)
    return f"04{text}0000"


@pytest.mark.parametrize("five_dof", HANDLES)
def test_tool_of_five_degrees_of_freedom_is_refused_at_the_start(five_dof, monkeypatch, tmp_path):
    name = "base" if five_dof == 10 else f"module {five_dof - 10}"
    client = Client([aurora(n, five_dof) for n in range(1, 100)])
    with pytest.raises(DeviceAbsent, match=f"the tool of the {name} has five degrees of freedom"):
        connected(monkeypatch, tmp_path, client, "aurora")


def test_tools_of_six_degrees_of_freedom_are_accepted_at_the_first_frame(monkeypatch, tmp_path):
    source, _ = connected(monkeypatch, tmp_path, Client([aurora(n, None) for n in range(1, 3)]), "aurora")
    assert source.read().device_frame == 2


def test_only_magnetic_tools_can_have_five_degrees_of_freedom(monkeypatch, tmp_path):
    source, _ = connected(monkeypatch, tmp_path, Client([reply(n) for n in range(1, 50)]))
    assert [source.read().device_frame for _ in range(49)] == list(range(1, 50))


# ---- The frame rate


def learned(hz, seconds, jitter_s=0.02, poll_s=1 / 60, seed=0, rate=None):
    rng, rate, newest = np.random.default_rng(seed), rate or FrameRate(), -1
    for at_s in np.arange(100.0, 100.0 + seconds, poll_s):
        number = int(at_s * hz + 0.3)
        if number > newest:
            newest = number
            rate.add(number, at_s + rng.uniform(0, jitter_s))
    return rate


@pytest.mark.parametrize("hz", [10.0, 20.0, 30.0, 40.0, 59.94, 60.0, 60.2, 250.0])
@pytest.mark.parametrize("seconds", [2.5, 10.0, 100.0])
def test_rate_is_learned(hz, seconds):
    """To one and a half frames, or the jitter, over the time of learning; from 60 s on it is final."""
    rate = learned(hz, seconds)
    step_s = max(0.02, 1 / 60, 1 / hz)
    assert rate.hz == pytest.approx(hz, rel=1.5 * step_s / min(seconds, 60.0))


def test_rate_is_unknown_at_first():
    assert learned(60.0, 1.9).hz is None


def test_known_rate_is_kept():
    assert learned(30.0, 10.0, rate=FrameRate(60.0)).hz == 60.0


@pytest.mark.parametrize("delay_s", [0.3, 5.0, -200.0])
def test_delay_and_restarted_count_do_not_change_the_rate(delay_s):
    """Frames that are late from one instant on, or counted from another number, begin another line."""
    rate, last = FrameRate(), 0
    for at_s in np.arange(0.0, 30.0, 1 / 60):
        number = int((at_s - (delay_s if at_s > 10.0 else 0.0)) * 30) + 10_000
        if number != last:
            rate.add(number, at_s)
        last = number
    assert rate.hz == pytest.approx(30.0, rel=0.004)
