"""Failure matrix, rows 50 to 55: calibrations that do not fit, and faults while one is measured. On virtual time."""

import itertools
import random

import msgspec
import numpy as np
import pytest
from tools_at_rest import ERRORS, Tracker, calibrated, measured, of_modules, straight

from modsoft.hil.polaris import write_tool_files
from modsoft.runtime import devices
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file, rest, rotations
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.devices import DeviceOptions
from modsoft.runtime.errors import DeviceAbsent, ModelError, Tripped

MODULES = 3
REFUSED = (Tripped, DeviceAbsent)  # the latter for a tool that is far out of the plane


class Bench:
    """A robot file with its tools and its calibration."""

    def __init__(self, folder):
        self.robot, self.path = folder / "robot.toml", folder / "robot.calibration.toml"
        self.tools = write_tool_files(folder, MODULES + 1)
        self.robot.write_text(robot_file.text_of("pneumatic-3").replace('name = "pneumatic-3"', 'name = "arm"'))
        tools = Tracker(ERRORS).measure(MODULES)
        self.calibration = rest.calibrated(measured(tools, file.sha256_of(self.tools)), "arm", None)
        self.write()

    def write(self, **changes):
        file.write(self.path, msgspec.structs.replace(self.calibration, **changes))

    def read_setup(self):
        """What modsoft-runtime reads before it opens a device."""
        options = DeviceOptions(str(self.robot), "", "", "/dev/tracker", tuple(self.tools), yes=True, dry_run=True)
        return devices.read_setup(options)


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


def refusal(call, kind):
    """The one line of a refusal; None without one."""
    try:
        call()
    except kind as error:
        text = str(error)
    else:
        return None
    assert "\n" not in text
    return text


def test_row_50_calibration_of_another_robot(matrix_row, bench):
    assert bench.read_setup().calibration.modules == MODULES
    cases = [{"robot": name} for name in ("pneumatic-3", "pneumatic-2", "Arm", "arm-2", "a")]
    cases += [{"modules": bench.calibration.modules[:count]} for count in range(MODULES)]
    refused = 0
    for changes in cases:
        bench.write(**changes)
        message = refusal(bench.read_setup, ModelError)
        refused += message is not None and "run modsoft-calibrate rest" in message
    matrix_row(
        50,
        fault="another name of the robot, fewer modules",
        tries=len(cases),
        limit="all refused, with the command to run",
        worst=f"{refused} refused",
    )
    assert refused == len(cases)


def test_row_51_calibration_of_other_tools(matrix_row, bench):
    refused = 0
    for tool, path in enumerate(bench.tools):
        before = path.read_bytes()
        path.write_bytes(before[:-1] + b"x")
        message = refusal(bench.read_setup, ModelError)
        again = f"rest --module {tool}" if tool else "rest"
        refused += message is not None and message.endswith(f"run modsoft-calibrate {again}")
        path.write_bytes(before)
    assert bench.read_setup().calibration is not None
    matrix_row(
        51,
        fault="one byte of a tool definition file differs",
        tries=len(bench.tools),
        limit="all refused, the tool named",
        worst=f"{refused} refused",
    )
    assert refused == len(bench.tools)


def damaged(text, chance):
    """The text with one to four characters replaced, dropped or inserted, or cut."""
    characters = list(text)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(characters))
        match chance.randrange(4):
            case 0:
                characters[at] = chr(chance.randrange(1, 0x250))
            case 1:
                del characters[at]
            case 2:
                characters.insert(at, chance.choice('0123456789.-e"[]=\n'))
            case 3 if at > 10:
                del characters[at:]
    return "".join(characters)


def test_row_52_damaged_calibration_file(matrix_row, bench, full):
    chance, text = random.Random(52), bench.path.read_text()
    tries, refused = 2000 if full else 200, 0
    for _ in range(tries):
        bench.path.write_text(damaged(text, chance), encoding="utf-8")
        if refusal(bench.read_setup, ModelError) is not None:
            refused += 1
            continue
        used = bench.read_setup().calibration  # a changed comment or digit
        assert np.isfinite(used.mounting.in_ends).all()
        turns = used.mounting.in_ends[:, :3, :3]
        products = turns @ np.swapaxes(turns, -1, -2)
        np.testing.assert_allclose(products, np.tile(np.eye(3), (MODULES + 1, 1, 1)), atol=1e-9)
    matrix_row(
        52,
        fault="one to four characters replaced, dropped, inserted, or the end cut",
        tries=tries,
        limit="refused in one line, or read as it states, with rotations",
        worst=f"{refused} refused, {tries - refused} read",
    )
    assert refused > tries / 4


def rest_of(calibration, tracker):
    """The check at rest of modsoft-runtime."""
    tracker.wait(0.0)
    use = UsedCalibration("c", "", calibration, MODULES)
    rig = devices.Devices(of_modules(MODULES), tracker.frames, None, tracker.now, tracker.wait, use)
    return rig.rest(rig.validator())


def test_row_53_tool_moved_since_the_calibration(matrix_row, full):
    rng, tries, missed, alarms = np.random.default_rng(53), 500 if full else 30, 0, 0
    for seed in range(tries):
        errors = ERRORS._replace(seed=seed % 10)
        calibration, _ = CALIBRATIONS.setdefault(seed % 10, calibrated(errors))
        tool, axis = rng.integers(4), rng.normal(size=3)
        turn = rotations.matrix(axis / np.linalg.norm(axis) * rng.uniform(8.0, 40.0))

        def moved(number, poses, tool=tool, turn=turn):
            poses[tool, :3, :3] = poses[tool, :3, :3] @ turn
            return {"poses": poses}

        missed += refusal(lambda: rest_of(calibration, Tracker(errors, change=moved)), REFUSED) is None  # noqa: B023
        still = Tracker(errors)
        still.number = int(rng.integers(10**6))
        alarms += refusal(lambda: rest_of(calibration, still), Tripped) is not None  # noqa: B023
    matrix_row(
        53,
        fault="a tool turned by 8 to 40 degrees about a random axis",
        tries=tries,
        limit="0 not refused",
        worst=missed,
        clock="virtual",
    )
    matrix_row(
        53, fault="none: noise of 0.5 degree and 0.1 mm", tries=tries, limit="0 refused", worst=alarms, clock="virtual"
    )
    assert (missed, alarms) == (0, 0)


CALIBRATIONS = {}


def motions(rng):
    """Bends over time that are no rest, as (name, function)."""
    axis = rng.integers(2)
    direction = np.eye(3)[axis]
    amplitude, hz, phase = rng.uniform(1.0, 5.0), rng.uniform(0.6, 3.0), rng.uniform(0.0, 2 * np.pi)
    rate, module, sign = rng.uniform(2.0, 20.0), rng.integers(MODULES), rng.choice([-1.0, 1.0])
    one, each = np.outer(np.arange(MODULES) == module, direction), np.outer(np.ones(MODULES), direction)
    return {
        "the robot swings": lambda at_s: each * amplitude * np.sin(2 * np.pi * hz * at_s + phase),
        "one module drifts": lambda at_s: one * sign * rate * (at_s - 100.0),
        "one module is bent by 40 degrees": lambda at_s: one * sign * 40.0,
        "all modules are bent by 15 degrees": lambda at_s: each * sign * 15.0,
    }


def test_row_54_robot_moves_or_is_bent_during_the_calibration(matrix_row, full):
    rng, tries = np.random.default_rng(54), 60 if full else 8
    accepted = dict.fromkeys(motions(rng), 0)
    for seed, fault in itertools.product(range(tries), accepted):
        tracker = Tracker(ERRORS._replace(seed=seed), motions(rng)[fault])
        accepted[fault] += (
            refusal(lambda: rest.calibrated(measured(tracker.measure(MODULES)), "arm", None), Tripped) is None  # noqa: B023
        )
    still = sum(
        refusal(lambda: calibrated(ERRORS._replace(seed=seed)), Tripped) is not None  # noqa: B023
        for seed in range(100, 100 + tries)
    )
    for fault, count in accepted.items():
        matrix_row(54, fault=fault, tries=tries, limit="0 accepted", worst=count, clock="virtual")
    matrix_row(54, fault="none: it hangs still", tries=tries, limit="0 refused", worst=still, clock="virtual")
    assert (set(accepted.values()), still) == ({0}, 0)


def test_row_55_tool_hidden_during_the_calibration(matrix_row, full):
    rng, tries, slowest_s = np.random.default_rng(55), 60 if full else 8, 0.0
    for _ in range(tries):
        tool, first = rng.integers(4), rng.integers(2, 95)
        tracker = Tracker(ERRORS, lambda at_s: straight(), hidden(tool, first))
        message = refusal(lambda: tracker.measure(MODULES), DeviceAbsent)  # noqa: B023
        name = f"module {tool}" if tool else "base"
        assert f"the last one tool hidden ({name}); are all tools in view?" in message
        slowest_s = max(slowest_s, tracker.time_s - 100.0 - first / 60)
    matrix_row(
        55,
        fault="a tool is hidden from a random frame on",
        tries=tries,
        limit="named within 6 s",
        worst=f"{slowest_s:.2f} s",
        clock="virtual",
    )
    assert slowest_s <= 6.0


def hidden(tool, first):
    return lambda number, poses: {"valid": (np.arange(len(poses)) != tool) | (number < first)}
