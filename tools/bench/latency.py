"""From the tracker's answer to the valve's register: how long each stage takes, for robots of 2, 3 and 5 modules.

`python tools/bench/latency.py --isa native|avx2`. The runtime's own loop runs on the emulated board and the fake
tracker, with a stamp at every border; the robot is a swinging row of poses. The stages:

    frame          the client's answer (after the tracker's own line) to a frame in the loop's slot
    configuration  judged, eq. (1), the feature window
    ONNX           the network
    set-points     limits, eq. (3), pressures
    serial         checked, handed to the thread of the port, encoded, written
    wire           the set-points' bytes at 250,000 baud
    firmware       from the last byte until the first timer register changes, with what the emulator adds

Between the first and the second a frame waits for the tick, which is no stage: it is the control rate. Ours is all but
wire and firmware. The clock is CLOCK_MONOTONIC on both sides, so a busy machine shows: its load average is told.

`--isa avx2` limits numpy. onnxruntime chooses its kernels by the processor and has no such switch.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from modsoft.hil import shipped
from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.plant import tool_poses
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.rig import Child
from modsoft.runtime import robot as robots
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.ports import open_port
from modsoft.runtime.board.protocol import CHANNELS, Set, encode
from modsoft.runtime.clock import Ticker, spinning
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.ort import onnxruntime
from modsoft.runtime.entry_point import entry
from modsoft.runtime.log_record import Record, TickRecord
from modsoft.runtime.loop import Loop
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.ndi import NDI
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.warmup import WarmUp

ROOT = Path(__file__).parents[2]
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
    directors = np.stack(
        [np.stack([cos, zero, -sin], -1), np.stack([zero, one, zero], -1), np.stack([sin, zero, cos], -1)], axis=1
    )
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


class StampedLatestFrame(LatestFrame):
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


def ticks(modules: int, count: int, model: Path, warm: bool = True) -> list[dict[str, float]]:
    """Milliseconds of every stage of every tick that went through all of them. `warm`: as the runtime, with its caches
    warmed before every tick."""
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
            slot = StampedLatestFrame(stamps)
            reader = Reader(NDI("polaris", str(port), tools, modules + 1), slot)
            controller = Model.load(model)
            controller.warm_up(modules)
            board = Board(StampedPort(open_port(emulated.port, robot.serial.baud), frame_bytes, written), emulated.port)
            board.arm(robot)
            stop = Stop()
            began_s = time.monotonic()

            def wait(seconds: float) -> None:
                """Between two ticks the robot moves."""
                tracker.send({"poses": swinging(modules, time.monotonic() - began_s)})
                stop.wait(min(seconds, 0.02))

            def log(record: Record) -> None:
                if isinstance(record, TickRecord) and record.sent and record.frame_status == "good":
                    assert record.frame is not None
                    lines.append({**stamps, "number": record.frame.number})

            judge = FrameValidator(robot)
            desired = np.repeat(from_angles_deg(np.zeros((1, modules))), count, axis=0)
            Loop(
                robot,
                Stamped(controller, "actuate", stamps, "features", "answer"),
                desired,
                slot,
                Stamped(judge, "judge", stamps, "taken", "judged"),
                Stamped(board, "set_pressures", stamps, "pressures", "handed"),
                Ticker(robot.loop.period_s, time.monotonic, spinning(wait)),
                stop,
                log,
                TickStatistics(robot, count),
                warm_up=WarmUp(robot, judge, log) if warm else None,
            ).run(from_angles_deg(np.zeros(modules)))
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


def about(isa: str) -> dict[str, Any]:
    """Where, with what and on what commit a run was made."""
    git = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return {
        "isa": isa,
        "processor": processor(),
        "system": platform.platform(),
        "cores": os.cpu_count(),
        "numpy": np.__version__,
        "onnxruntime": onnxruntime.__version__,
        "commit": git.stdout.strip() or "unknown",
        "load_average": os.getloadavg()[0],
        "hz": HZ,
        "target_ms": TARGET_MS,
    }


def processor() -> str:
    """The processor's name and which vector instructions numpy uses of it."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = names[0] if names else name
    return f"{name}, numpy with {', '.join(numpy_features()) or 'its baseline'}"


def numpy_features() -> list[str]:
    """The instruction sets above its baseline that numpy uses."""
    return list(np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))  # type: ignore[call-overload]


def limited_to_avx2() -> dict[str, str]:
    """The environment that keeps numpy from instruction sets beyond AVX2."""
    wider = [name for name in numpy_features() if "512" in name or name == "X86_V4"]
    return {"NPY_DISABLE_CPU_FEATURES": " ".join(wider)}


def table(result: dict[str, Any]) -> str:
    """One run in Markdown."""
    columns, described = (*STAGES, "ours", "all"), result["about"]
    lines = [
        f"Instruction set {described['isa']}: {described['processor']}; {described['cores']} cores, onnxruntime "
        f"{described['onnxruntime']}, numpy {described['numpy']}, commit {described['commit']}, load average "
        f"{described['load_average']:.1f}. Milliseconds, median (99th percentile).",
        "",
    ]
    lines += ["| modules | warm-up | ticks | " + " | ".join(columns) + " | all / wire |"]
    lines += ["| ---: | --- " + "| ---: " * (len(columns) + 2) + "|"]
    for row in result["rows"]:
        cells = [f"{row[name]['p50_ms']:.2f} ({row[name]['p99_ms']:.2f})" for name in columns]
        warm = "yes" if row["warm"] else "no"
        lines.append(
            f"| {row['modules']} | {warm} | {row['ticks']} | {' | '.join(cells)} | {row['all_over_wire']:.1f} |"
        )
    over = [str(row["modules"]) for row in result["rows"] if row["warm"] and row["ours"]["p50_ms"] > TARGET_MS]
    verdict = f"missed with {', '.join(over)} modules" if over else "reached"
    return "\n".join([*lines, "", f"All but wire and firmware within {TARGET_MS:g} ms at the median: {verdict}."])


def document(folder: Path) -> str:
    """The page of all runs kept in `folder`, one JSON file an instruction set."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    tables = "\n\n".join(table(result) for result in results)
    return f"""# Latency

From the tracker's answer to the first changed timer register of the emulated board, by stage. `ours` is all but wire
and firmware; the target is {TARGET_MS:g} ms at the median. `frame`: the tracker client's answer becomes a frame;
`configuration`: its checks, eq. (1) and the feature window; `ONNX`: the network; `set-points`: limits, eq. (3),
pressures; `serial`: checks, hand-over to the thread of the port, encoding, writing; `wire`: {CHANNELS} set-points at
250,000 baud; `firmware`: to the register, with what the emulator adds. Each table is made by

    python tools/bench/latency.py --isa native|avx2 --report docs/latency.md

The loop sleeps between two control steps, and a step that begins with cold caches takes about twice as long. So the
runtime runs the computation of a step up to three times just before the step is due and discards the results
(`runtime/warmup.py`). The rows without warm-up show the same code without that.

`avx2` limits numpy. onnxruntime selects its kernels by the processor and has no option to limit them, so the `ONNX`
column is the same code in both tables.

{tables}
"""


@click.command(help=__doc__)
@click.option(
    "--isa",
    type=click.Choice(["native", "avx2"]),
    default="native",
    show_default=True,
    help="Instruction set of numpy.",
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--report", type=click.Path(path_type=Path), help="Markdown page to update.")
@click.option("--quick", is_flag=True, help="60 ticks in place of 120 each, with warm-up alone: less than a minute.")
@click.option(
    "--model",
    type=click.Path(exists=True, path_type=Path),
    help="Controller of modsoft-export, for any number of modules.  [default: the shipped one]",
)
def main(isa: str, json_file: Path | None, report: Path | None, quick: bool, model: Path | None) -> None:
    if isa == "avx2" and (limits := limited_to_avx2())["NPY_DISABLE_CPU_FEATURES"]:
        # numpy reads the limit when it is imported
        raise SystemExit(subprocess.run([sys.executable, *sys.argv], env=os.environ | limits).returncode)
    count = 60 if quick else 120
    model = model or shipped.model()
    described, rows = about(isa), []
    for modules in MODULES:
        for warm in (True,) if quick else (True, False):
            rows.append({**figures(modules, count, ticks(modules, count, model, warm)), "warm": warm})
    result = {"about": described, "rows": rows}
    click.echo(table(result))
    text = json.dumps(result, indent=1) + "\n"
    if json_file:
        json_file.write_text(text, encoding="utf-8")
    if report:
        folder = report.with_suffix("")
        folder.mkdir(exist_ok=True)
        (folder / f"{isa}.json").write_text(text, encoding="utf-8")
        report.write_text(document(folder), encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
