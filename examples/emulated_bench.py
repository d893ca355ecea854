"""Board, tracker and robot, emulated, to try docs/rig.md: python examples/emulated_bench.py robot.toml [simavr|native]

Writes `bench.toml`: the robot file with the ports of the emulated devices. Runs until Ctrl-C.
"""

import re
import shutil
import signal
import sys
import tempfile
from pathlib import Path

from modsoft.hil.rig import Rig


def main(robot_file: str, board: str = "auto") -> None:
    text = Path(robot_file).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder, Rig(robot_file, Path(folder), board) as rig:
        tools = [shutil.copy(tool, Path.cwd()) for tool in rig.tool_files]
        text = re.sub(r"tools = \[.*?\]", f"tools = {[Path(tool).name for tool in tools]}".replace("'", '"'), text)
        text = re.sub(r'port = ".*?"', f'port = "{rig.tracker_port}"', text, count=1)
        head, serial, rest = text.partition("[serial]")
        text = head + serial + re.sub(r'port = ".*?"', f'port = "{rig.board.port}"', rest, count=1)
        Path("bench.toml").write_text(text, encoding="utf-8")
        print(f"bench.toml: tracker at {rig.tracker_port}, board at {rig.board.port}; Ctrl-C ends them", flush=True)
        try:
            signal.sigwait({signal.SIGINT, signal.SIGTERM})
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    main(*sys.argv[1:])
