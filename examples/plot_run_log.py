"""Plot the bending angles of a run: python examples/plot_run_log.py RUN_FOLDER [PICTURE]"""

import sys
from pathlib import Path

import numpy as np

from modsoft.runtime import log_reader
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.training import plotting


def main() -> None:
    run = log_reader.read(Path(sys.argv[1]))
    picture = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("angles.png")
    ticks = [tick for tick in run.ticks if tick.configuration is not None]  # None: no valid frame in that step
    steps = [tick.tick for tick in ticks]
    measured = bending_angle_deg(np.array([tick.configuration for tick in ticks]))
    desired = bending_angle_deg(np.array([tick.desired for tick in ticks]))

    def draw():
        figure = plotting.figure(7.0, 4.0)
        axes = figure.subplots()
        for module in range(measured.shape[1]):
            axes.plot(steps, desired[:, module], "--", color=f"C{module}")
            axes.plot(steps, measured[:, module], color=f"C{module}", label=f"module {module + 1}")
        axes.set(xlabel="control step", ylabel="bending angle, degrees (dashed: desired)")
        axes.legend()
        return figure

    plotting.save(draw, picture, dpi=150)
    print(picture)


if __name__ == "__main__":
    main()
