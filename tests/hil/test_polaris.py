"""The fake tracker: its protocol without a line, and what the faults do."""

import json
import struct
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from modsoft.hil.byte_damage import KINDS, ByteDamage
from modsoft.hil.polaris import Pty, write_tool_files
from modsoft.hil.polaris_device import Polaris, crc16
from modsoft.hil.rotations import quaternion, turn, without_roll
from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.tracking.frame import FrameError
from modsoft.runtime.tracking.ndi import NDI


def framed(command: str) -> bytes:
    return f"{command}{crc16(command.encode()):04X}".encode()


class Device(Polaris):
    """On a clock that the test moves."""

    def __init__(self, **options):
        self.time_s = 100.0
        super().__init__(lambda: self.time_s, **options)

    def ask(self, command: str) -> str:
        """The text of an answer, its checksum proven."""
        answer = self.answer(framed(command)).decode()
        assert answer.endswith("\r")
        assert answer[-5:-1] == f"{crc16(answer[:-5].encode()):04X}"
        return answer[:-5]

    def set_up(self, tools: int, start: bool = True) -> "Device":
        assert self.ask("INIT:") == "OKAY"
        for _ in range(tools):
            handle = self.ask("PHRQ:*********1****")
            assert self.ask(f"PVWR:{handle}0000" + "00" * 64) == "OKAY"
            assert self.ask(f"PINIT:{handle}") == "OKAY"
            assert self.ask(f"PENA:{handle}D") == "OKAY"
        if start:
            assert self.ask("TSTART:") == "OKAY"
        return self

    def tools(self) -> list[tuple[str, str, int]]:
        """(handle, transform or MISSING, frame number) of each tool in a TX answer."""
        text = self.ask("TX:0801")
        rows = text[2:].split("\n")[:-1]
        assert len(rows) == int(text[:2], 16)
        return [(row[:2], row[2:-16], int(row[-8:], 16)) for row in rows]


def poses(count: int) -> list:
    stack = np.tile(np.eye(4), (count, 1, 1))
    stack[:, 2, 3] = -1000.0 - 50.0 * np.arange(count)
    return stack.tolist()


def test_checksum_as_the_client_sends_it():
    # The bytes that ndicapi has built in for its probe.
    assert framed("INIT:") == b"INIT:E3A5"
    assert Device().answer(b"INIT:E3A5") == b"OKAYA896\r"
    assert framed("GETINFO:Features.Firmware.Version") == b"GETINFO:Features.Firmware.Version0492"


def test_wrong_checksum_is_refused():
    assert Device().answer(b"INIT:0000").startswith(b"ERROR04")


@pytest.mark.parametrize("command", ["TX:0801", "TX 0801", "BX:0801"])
def test_no_frames_before_the_start(command):
    device = Device().set_up(2, start=False)
    answer = device.answer(framed(command) if ":" in command else command.encode())
    assert answer.startswith(b"ERROR0C")


@pytest.mark.parametrize(
    ("command", "code"),
    [("PINIT:0A", "08"), ("PENA:0AD", "08"), ("TX:FFFF", "01"), ("PHSR:77", "01"), ("NONSENSE:", "01")],
)
def test_wrong_calls_are_refused(command, code):
    assert Device().set_up(0, start=command.startswith("TX")).ask(command) == f"ERROR{code}"


def test_nothing_before_init():
    assert Device().ask("PHRQ:*********1****") == "ERROR10"


def test_order_of_set_up_is_enforced():
    device = Device().set_up(0, start=False)
    handle = device.ask("PHRQ:*********1****")
    assert device.ask(f"PINIT:{handle}") == "ERROR0D"  # no tool definition yet
    device.ask(f"PVWR:{handle}0000" + "00" * 64)
    assert device.ask(f"PENA:{handle}D") == "ERROR0E"
    assert device.ask("PHSR:02") == f"01{handle}001"
    device.ask(f"PINIT:{handle}")
    assert device.ask("PHSR:03") == f"01{handle}001"
    device.ask("TSTART:")
    assert device.tools() == []  # initialised, but not enabled
    assert device.ask(f"PENA:{handle}D") == "ERROR0C"  # not while it tracks


def test_transforms_are_rounded_as_on_the_device():
    device = Device().set_up(1)
    pose = np.eye(4)
    pose[:3, 3] = [1.234, -5.678, -1400.129]
    device.take({"poses": [pose.tolist()]})
    [(_, transform, _)] = device.tools()
    assert transform == "+10000+00000+00000+00000" + "+000123-000568-140013" + "+01000"


def test_binary_answer():
    device = Device().set_up(2)
    device.take({"poses": poses(2), "hide": [1]})
    answer = device.answer(framed("BX:0801"))
    start, length, header_crc = struct.unpack("<HHH", answer[:6])
    body = answer[6:-2]
    assert (start, length, header_crc) == (0xA5C4, len(body), crc16(answer[:4]))
    assert struct.unpack("<H", answer[-2:])[0] == crc16(body) == crc16(answer[:-2])
    assert body[:3] == bytes([2, 0x0A, 1])
    assert struct.unpack("<8f", body[3:35])[:7] == (1, 0, 0, 0, 0, 0, -1000)
    assert body[43:45] == bytes([0x0B, 2])  # missing: no transform
    assert len(body) == 1 + 42 + 10 + 2


def test_frame_numbers_run_at_60_hz_without_new_poses():
    device = Device().set_up(1)
    device.take({"poses": poses(1)})
    before = device.tools()[0][2]
    device.time_s += 10.0
    assert device.tools()[0][2] == before + 600


def test_faults():
    device = Device().set_up(3)
    device.take({"poses": poses(3)})
    whole = device.tools()
    device.take({"hide": [1]})
    assert [transform == "MISSING" for _, transform, _ in device.tools()] == [False, True, False]
    device.take({"hide": [], "lose": [2]})
    assert [handle for handle, *_ in device.tools()] == ["0A", "0B"]
    device.take({"lose": [], "swap": [0, 2]})
    assert [t for _, t, _ in device.tools()] == [whole[2][1], whole[1][1], whole[0][1]]
    device.take({"swap": None, "jump": {"tool": 1, "mm": [10.0, 0, 0], "deg": 90.0}})
    assert device.tools()[1][1].startswith("+07071+00000+07071+00000+001000")
    device.take({"jump": None, "back": 5})
    device.time_s += 1.0
    assert device.tools()[0][2] == whole[0][2] + 55
    device.take({"back": 0})
    assert device.answer(framed("TX:0801")) == (device.take({"corrupt": False}) or device.answer(framed("TX:0801")))
    device.take({"corrupt": True})
    corrupted = device.answer(framed("TX:0801"))
    assert corrupted[-5:-1] != f"{crc16(corrupted[:-5]):04X}".encode()
    device.take({"mute": True})
    assert device.answer(framed("TX:0801")) == b""


def test_frozen_and_delayed():
    device = Device().set_up(1)
    for step in range(50):
        pose = np.eye(4)
        pose[2, 3] = -step
        device.take({"poses": [pose.tolist()]})
        device.time_s += 0.02
    device.take({"delay_s": 0.49})
    _, transform, number = device.tools()[0]
    assert (transform[38:45], number) == ("-002500", 30)
    device.take({"delay_s": 0.0, "freeze": True})
    frozen = device.tools()
    device.time_s += 1.0
    device.take({"poses": poses(1)})
    assert device.tools() == frozen
    device.take({"freeze": False})
    assert device.tools() != frozen


def test_status_rms_error_and_roll_of_a_tool():
    device = Device().set_up(3)
    device.take({"poses": poses(3), "rms_mm": {"1": 5.0}, "port_status": {"2": 0x71}})
    text = device.ask("TX:0801")
    rows = text[2:].split("\n")[:3]
    assert [row[47:53] for row in rows] == ["+01000", "+50000", "+01000"]
    assert [row[-16:-8] for row in rows] == ["00000031", "00000031", "00000071"]
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # 90 degrees about z
    device.take({"poses": [turned.tolist()] * 3, "five_dof": [0]})
    quaternions = [transform[:24] for _, transform, _ in device.tools()]
    assert quaternions == ["+10000+00000+00000+00000", *["+07071+00000+00000+07071"] * 2]


@example([0.0, 0.0, 1.0, 0.0])
@example([5e-324, 0.5, 0.5, 0.0])
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_without_roll_keeps_the_direction_of_the_tool(values):
    q = tuple(np.array(values) / np.linalg.norm(values))
    w, x, y, z = without_roll(q)
    assert z == 0.0
    assert w * w + x * x + y * y == pytest.approx(1.0)
    np.testing.assert_allclose(np.array(turn((w, x, y, z)))[:, 2], np.array(turn(q))[:, 2], atol=1e-9)


def test_other_frame_rate():
    device = Device(frame_hz=20.0).set_up(1)
    before = device.tools()[0][2]
    device.time_s += 10.0
    assert device.tools()[0][2] == before + 200


def test_aurora_is_turned_as_a_whole():
    """Every tool has some roll, which a tool of five degrees of freedom never has."""
    device = Device(kind="aurora", wired=2)
    assert device.ask("INIT:") == "OKAY"
    for handle in ("0A", "0B"):
        device.ask(f"PINIT:{handle}")
        device.ask(f"PENA:{handle}D")
    device.ask("TSTART:")
    device.take({"poses": poses(2)})
    first, second = (transform for _, transform, _ in device.tools())
    assert first[:24] == second[:24]
    assert int(first[18:24]) != 0


REPLY = b"0A" + bytes(range(48, 58)) * 5 + b"\r"


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_of_its_kind_and_the_same_for_a_seed(kind):
    damage, again = (ByteDamage(seed=1, kinds=[kind]) for _ in range(2))
    for _ in range(200):
        parts = damage.apply(REPLY)
        assert parts == again.apply(REPLY)
        sent = b"".join(part for _, part in parts)
        changed = [a ^ b for a, b in zip(sent, REPLY, strict=False) if a != b]
        match kind:
            case "flip":
                assert len(sent) == len(REPLY)
                assert len(changed) <= 3
            case "bit 7":
                assert set(changed) <= {0x80}
                assert len(sent) == len(REPLY)
            case "drop":
                assert len(REPLY) - 3 <= len(sent) < len(REPLY)
            case "insert":
                assert len(REPLY) < len(sent) <= len(REPLY) + 3
            case "no return":
                assert sent == REPLY[:-1]
            case "delay":
                assert sent == REPLY
                assert all(0 <= pause_s <= 0.01 for pause_s, _ in parts)


def test_damage_has_a_rate_and_known_kinds():
    damage = ByteDamage(seed=2, rate=0.25, kinds=["drop"])
    damaged = sum(damage.apply(REPLY) != [(0.0, REPLY)] for _ in range(1000))
    assert 200 < damaged < 300
    with pytest.raises(ValueError, match="melt"):
        ByteDamage(seed=1, kinds=["melt"])


def test_only_replies_while_tracking_are_damaged():
    device = Device()
    device.take({"damage": {"seed": 1, "kinds": ["no return"]}})
    assert device.sent(device.answer(b"INIT:E3A5")) == [(0.0, b"OKAYA896\r")]
    device.set_up(1)
    assert not device.sent(device.answer(framed("TX:0801")))[-1][1].endswith(b"\r")
    device.take({"damage": None})
    assert device.sent(device.answer(framed("TX:0801")))[-1][1].endswith(b"\r")


def test_unknown_fault_is_an_error():
    with pytest.raises(ValueError, match="explode"):
        Device().take({"explode": True})


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_quaternion_gives_the_rotation_back(values):
    q = np.array(values)
    if np.linalg.norm(q) < 1e-3:
        q = np.array([0.0, 0.0, 0.0, 1.0])
    w, x, y, z = q / np.linalg.norm(q)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation
    result = np.array(quaternion(pose.tolist()))
    assert result[0] >= 0
    assert abs(result @ [w, x, y, z]) == pytest.approx(1.0, abs=1e-12)


def test_file_in_the_place_of_the_port_stays(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UsageError, match="file: exists and is no link"):
        Pty(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_tool_files_differ(tmp_path):
    paths = write_tool_files(tmp_path, 3)
    assert [path.name for path in paths] == ["base.rom", "module-1.rom", "module-2.rom"]
    assert len({path.read_bytes() for path in paths}) == 3


# ---- The unmodified client on the real line ------------------------------------------------------------------------


class Rig:
    """The process, and a source connected to it."""

    def __init__(self, folder, tools=4, *options):
        self.link = folder / "ttyPolaris"
        self.tools = write_tool_files(folder, tools)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "modsoft.hil.polaris", "--link", str(self.link), *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        ready = json.loads(self.process.stdout.readline())
        assert ready["event"] == "ready"
        self.port = ready["port"]

    def send(self, **line):
        self.process.stdin.write(json.dumps(line) + "\n")
        self.process.stdin.flush()

    def connect(self, kind="polaris"):
        return NDI(kind, self.port, self.tools if kind != "aurora" else [], len(self.tools))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait(5)
        self.process.stdout.close()


def read_until(source, condition, reads=200):
    """The first frame that fulfils the condition."""
    for _ in range(reads):
        try:
            frame = source.read()
        except FrameError:
            continue
        if frame is not None and condition(frame):
            return frame
    raise AssertionError(f"no such frame in {reads} reads")


# The client asks a "Rev 009" for the binary answer, which it cannot carry; the runtime asks for text in any case.
@pytest.mark.parametrize("firmware", ["Polaris Spectra Rev 009", "Polaris Spectra Rev 007"])
@pytest.mark.parametrize("tools", [3, 4, 9])
def test_real_client_reads_what_is_shown(tmp_path, firmware, tools):
    with Rig(tmp_path, tools, "--firmware", firmware) as rig:
        shown = np.array(poses(tools))
        angle = np.radians(30.0)
        shown[1, :3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        rig.send(poses=shown.tolist())
        source = rig.connect()
        assert source.device == f"{firmware}, serial number P7-00000"
        frame = read_until(source, lambda frame: frame.valid.all())
        np.testing.assert_allclose(frame.poses, shown, atol=2e-4)
        np.testing.assert_allclose(frame.quality, 0.1)
        later = read_until(source, lambda frame: True)
        assert later.device_frame > frame.device_frame
        assert later.monotonic_s > frame.monotonic_s
        source.close()


def test_real_client_sees_the_faults(tmp_path):
    with Rig(tmp_path) as rig:
        rig.send(poses=poses(4))
        source = rig.connect()
        read_until(source, lambda frame: frame.valid.all())
        rig.send(hide=[2])
        hidden = read_until(source, lambda frame: not frame.valid.all())
        assert hidden.valid.tolist() == [True, True, False, True]
        assert np.isnan(hidden.poses[2, :3, :]).all()
        assert np.isnan(hidden.quality[2])
        rig.send(hide=[], lose=[3])
        lost = read_until(source, lambda frame: not frame.valid[3])
        assert lost.device_frame > hidden.device_frame  # a tool that is left out does not set the number back
        rig.send(lose=[])
        number = read_until(source, lambda frame: frame.valid.all()).device_frame
        rig.send(freeze=True)
        while (frame := source.read()) is not None:  # what was on the line already
            number = frame.device_frame
        assert [source.read() for _ in range(5)] == [None] * 5
        rig.send(freeze=False)
        assert read_until(source, lambda frame: True).device_frame > number
        rig.send(unplug=True)
        with pytest.raises(DeviceAbsent, match="tracker at"):
            read_until(source, lambda frame: False)
        source.close()


def relative(stack):
    """Poses in the frame of the base."""
    return np.linalg.inv(stack[0]) @ stack


@pytest.mark.parametrize(
    ("kind", "options"),
    [("polaris", []), ("vega", ["--type", "vega"]), ("aurora", ["--type", "aurora", "--wired", "4"])],
)
def test_real_client_reconnects(kind, options, tmp_path):
    """To each type that a robot file may have."""
    with Rig(tmp_path, 4, *options) as rig:
        rig.send(poses=poses(4))
        for _ in range(2):
            source = rig.connect(kind)
            frame = read_until(source, lambda frame: frame.valid.all())
            # An Aurora is turned; its rounding of rotations counts at the distance of a tool.
            np.testing.assert_allclose(relative(frame.poses), relative(np.array(poses(4))), atol=0.3)
            source.close()


def test_real_client_loses_a_vega_and_finds_it_again(tmp_path):
    with Rig(tmp_path, 4, "--type", "vega") as rig:
        rig.send(poses=poses(4))
        source = rig.connect("vega")
        read_until(source, lambda frame: frame.valid.all())
        rig.send(unplug=True)
        with pytest.raises(DeviceAbsent, match=f"tracker at {rig.port}"):
            read_until(source, lambda frame: False)
        source.close()
        rig.send(unplug=False, poses=poses(4))
        source = found_again(rig, "vega")
        read_until(source, lambda frame: frame.valid.all())
        source.close()


def found_again(rig, kind):
    """The tracker at last: until the rig has obeyed, it still hangs up."""
    patience = time.monotonic() + 20
    while True:
        try:
            return rig.connect(kind)
        except DeviceAbsent:
            assert time.monotonic() < patience


def test_no_vega_at_the_address_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)  # a machine without ping
    with pytest.raises(DeviceAbsent, match=r"no vega tracker answers at 127\.0\.0\.1:1 "):
        NDI("vega", "127.0.0.1:1", write_tool_files(tmp_path, 4), 4)


@pytest.mark.realtime
def test_mute_device_is_an_error(tmp_path):
    with Rig(tmp_path) as rig:
        rig.send(mute=True)
        began = time.monotonic()
        with pytest.raises(DeviceAbsent, match="no polaris tracker answers"):
            rig.connect()
        assert time.monotonic() - began < 15
