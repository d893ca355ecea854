"""From the tracker's answer to the valve's register: how long each stage takes, for robots of 2, 3 and 5 modules.

`python tools/bench/latency.py`. The runtime's own loop runs on the emulated board and the fake tracker, with a stamp at
every border; the robot is a swinging row of poses. The stages:

    frame          the client's answer (after the tracker's own line) to a frame in the loop's slot
    configuration  judged, eq. (1), the feature window
    ONNX           the network
    set-points     limits, eq. (3), pressures
    serial         checked, handed to the thread of the port, encoded, written
    wire           the set-points' bytes at 250,000 baud
    firmware       from the last byte until the first timer register changes, with what the emulator adds

Between the first and the second a frame waits for the tick, which is no stage: it is the control rate. Ours is all but
wire and firmware. The clock is CLOCK_MONOTONIC on both sides, so a busy machine shows: its load average is told.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from modsoft.hil import shipped
from modsoft.hil.emulator import EmulatedBoard
from modsoft.hil.plant import tool_poses
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.rig import Child
from modsoft.runtime import robot as robots
from modsoft.runtime.board import Board
from modsoft.runtime.clock import Ticker
from modsoft.runtime.command import entry
from modsoft.runtime.configuration import from_angles_deg
from modsoft.runtime.controller import Controller
from modsoft.runtime.log import host
from modsoft.runtime.loop import Loop
from modsoft.runtime.ndi import NDI
from modsoft.runtime.ports import open_port
from modsoft.runtime.protocol import CHANNELS, Set, encode
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameJudge
from modsoft.runtime.stop import Stop
from modsoft.runtime.tally import Tally
from modsoft.runtime.tracker import Reader, Slot

MODULES = (2, 3, 5)
HZ = 7.0  # faster than the robot, to have many ticks soon; the tracker's line takes 40 ms for six tools
STAGES = ("frame", "configuration", "ONNX", "set-points", "serial", "wire", "firmware")
OURS = STAGES[:5]
SWING_DEG, SWING_S = 12.0, 3.1
MODULE_M = 0.05
REGISTER_WAIT_S = 0.08
TARGET_MS = 2.0

Stamps = dict[str, float]  # border: seconds of the monotonic clock


def robot_of(modules: int, hz: float) -> Robot:
    """The shipped three-module robot with another number of modules, two channels each."""
    table = robots.load("pneumatic-3").to_dict()
    table["robot"] |= {"modules": modules, "name": f"pneumatic-{modules}"}
    table["loop"] |= {"hz": hz, "task": ""}
    table["chambers"] = [
        {**table["chambers"][0], "module": channel // 2 + 1, "side": "+-"[channel % 2], "channel": channel}
        for channel in range(2 * modules)
    ]
    return robots.from_dict(table, f"pneumatic-{modules}")


def swinging(modules: int, at_s: float) -> list[Any]:
    """Poses of the tools: every module bends to and fro in the plane."""
    bend = np.radians(SWING_DEG * np.sin(2 * np.pi * at_s / SWING_S + np.arange(modules)))
    tilt = np.cumsum(bend)
    cos, sin = np.cos(tilt), np.sin(tilt)
    zero, one = np.zeros(modules), np.ones(modules)
    directors = np.stack([np.stack([cos, zero, -sin], -1), np.stack([zero, one, zero], -1),
                          np.stack([sin, zero, cos], -1)], axis=1)  # fmt: skip
    positions = MODULE_M * np.cumsum(directors[:, 2], axis=0)
    return tool_poses(positions, directors).tolist()


class Stamped:
    """Stands before any object: calls of one of its methods are stamped as `enter` and `leave`."""

    def __init__(self, inside: Any, method: str, stamps: Stamps, enter: str, leave: str):
        self._inside, self._method = inside, method
        self._stamps, self._enter, self._leave = stamps, enter, leave

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._inside, name)
        if name != self._method:
            return found

        def stamped(*arguments: Any) -> Any:
            self._stamps[self._enter] = time.monotonic()
            answer = found(*arguments)
            self._stamps[self._leave] = time.monotonic()
            return answer

        return stamped


class StampedSlot(Slot):
    """Keeps for each frame when the tracker had answered and when the frame was there."""

    def __init__(self, stamps: Stamps):
        super().__init__()
        self._stamps = stamps
        self.frames: dict[int, tuple[float, float]] = {}

    def put(self, frame: Any) -> None:
        super().put(frame)
        self.frames[frame.device_frame] = (self._stamps["answered"], time.monotonic())


class StampedPort:
    """A serial port that keeps when set-points were written to it, `written` (seconds)."""

    def __init__(self, port: Any, shortest: int, written: list[float]):
        """`shortest`: bytes of a write that carries set-points, at least."""
        self.__dict__.update(_port=port, _shortest=shortest, _written=written)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._port, name, value)

    def write(self, data: bytes) -> Any:
        answer = self._port.write(data)
        if len(data) >= self._shortest:
            self._written.append(time.monotonic())
        return answer


def ticks(modules: int, count: int, model: Path) -> list[dict[str, float]]:
    """Milliseconds of every stage of every tick that went through all of them."""
    import ndicapy

    robot, stamps, lines, written = robot_of(modules, HZ), Stamps(), list[Stamps](), list[float]()
    answer, frame_bytes = ndicapy.ndiCommand, len(encode(Set(0, (0,) * CHANNELS)))
    with tempfile.TemporaryDirectory() as folder, EmulatedBoard() as emulated:
        port, tools = Path(folder) / "ttyPolaris", write_tool_files(Path(folder), modules + 1)
        tracker = Child("modsoft.hil.polaris", ["--link", str(port)], lambda line: None)
        ndicapy.ndiCommand = Stamped(ndicapy, "ndiCommand", stamps, "asked", "answered").ndiCommand
        emulated.send("sensors 50")  # else they see no pressure, and the board takes that for a leak
        try:
            tracker.wait_ready()
            tracker.send({"poses": swinging(modules, 0.0)})
            slot = StampedSlot(stamps)
            reader = Reader(NDI("polaris", str(port), tools, modules + 1), slot)
            controller = Controller.load(model)
            controller.warm_up(modules)
            board = Board(StampedPort(open_port(emulated.port, robot.serial.baud), frame_bytes, written), emulated.port)
            board.arm(robot)
            stop = Stop()
            began_s = time.monotonic()

            def wait(seconds: float) -> None:
                """Between two ticks the robot moves."""
                tracker.send({"poses": swinging(modules, time.monotonic() - began_s)})
                stop.wait(min(seconds, 0.02))

            def log(line: dict[str, Any]) -> None:
                if line.get("sent") and line["verdict"] == "good":
                    lines.append({**stamps, "number": line["frame"]["number"]})

            desired = np.repeat(from_angles_deg(np.zeros((1, modules))), count, axis=0)
            Loop(
                robot, Stamped(controller, "actuate", stamps, "features", "answer"), desired, slot,
                Stamped(FrameJudge(robot), "judge", stamps, "taken", "judged"),
                Stamped(board, "set_pressures", stamps, "pressures", "handed"),
                Ticker(robot.loop.period_s, time.monotonic, wait), stop, log, Tally(robot, count),
            ).run(from_angles_deg(np.zeros(modules)))  # fmt: skip
            board.close()
            reader.close()
        finally:
            ndicapy.ndiCommand = answer
            tracker.stop()
        changes = np.array([event["mono_ns"] for event in emulated.trace if event["event"] == "pwm"]) * 1e-9
    wire_s = frame_bytes * 10 / robot.serial.baud
    found = (stages(line, slot.frames, np.array(written), changes, wire_s) for line in lines)
    return [each for each in found if each is not None]


def stages(
    line: Stamps, frames: dict[int, tuple[float, float]], written: Any, changes: Any, wire_s: float
) -> dict[str, float] | None:
    """Milliseconds of the stages of one tick; None where no register had to change, or one was still moving."""
    answered_s, there_s = frames[int(line["number"])]
    writes = written[written >= line["pressures"]]
    if not len(writes):
        return None
    written_s = writes[0]
    moved = changes[(changes >= line["pressures"]) & (changes <= written_s + wire_s + REGISTER_WAIT_S)]
    if not len(moved) or moved[0] < written_s + wire_s:
        return None
    in_loop_s = [line[border] for border in ("taken", "features", "answer", "pressures")]
    spans_s = [there_s - answered_s, *np.diff([*in_loop_s, written_s, written_s + wire_s, moved[0]])]
    found = {stage: 1e3 * float(span_s) for stage, span_s in zip(STAGES, spans_s, strict=True)}
    return {**found, "ours": sum(found[stage] for stage in OURS), "all": sum(found.values())}


def figures(modules: int, asked: int, found: list[dict[str, float]]) -> dict[str, Any]:
    """Median and 99th percentile of every stage, ms."""
    row: dict[str, Any] = {"modules": modules, "ticks": len(found), "of": asked}
    for stage in (*STAGES, "ours", "all"):
        p50, p99 = np.percentile([each[stage] for each in found], [50, 99], method="higher")
        row[stage] = {"p50_ms": float(p50), "p99_ms": float(p99)}
    row["all_over_wire"] = row["all"]["p50_ms"] / row["wire"]["p50_ms"]
    row["ours_over_wire"] = row["ours"]["p50_ms"] / row["wire"]["p50_ms"]
    return row


def table(result: dict[str, Any]) -> str:
    columns = (*STAGES, "ours", "all")
    lines = [f"{result['system']}, {result['cores']} cores, load average {result['load_average']:.1f}; "
             f"milliseconds, median (99th percentile); ours: all but wire and firmware", ""]  # fmt: skip
    lines += ["| modules | ticks | " + " | ".join(columns) + " | all / wire |"]
    lines += ["| ---: " * (len(columns) + 3) + "|"]
    for row in result["rows"]:
        cells = [f"{row[name]['p50_ms']:.2f} ({row[name]['p99_ms']:.2f})" for name in columns]
        lines.append(f"| {row['modules']} | {row['ticks']} | {' | '.join(cells)} | {row['all_over_wire']:.1f} |")
    over = [str(row["modules"]) for row in result["rows"] if row["ours"]["p50_ms"] > TARGET_MS]
    verdict = f"missed with {', '.join(over)} modules" if over else "reached"
    return "\n".join([*lines, "", f"All but wire and firmware within {TARGET_MS:g} ms at the median: {verdict}."])


@click.command(help=__doc__)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--quick", is_flag=True, help="60 ticks in place of 600 each: less than a minute.")
@click.option("--model", type=click.Path(exists=True, path_type=Path),
              help="Controller of modsoft-export, for any number of modules.  [default: the shipped one]")  # fmt: skip
def main(json_file: Path | None, quick: bool, model: Path | None) -> None:
    count = 60 if quick else 600
    about = {**host(), "load_average": os.getloadavg()[0], "hz": HZ, "target_ms": TARGET_MS}
    about.pop("name")
    model = model or shipped.model()
    rows = [figures(modules, count, ticks(modules, count, model)) for modules in MODULES]
    result = {**about, "rows": rows}
    click.echo(table(result))
    if json_file:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
