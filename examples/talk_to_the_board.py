"""Arm a board, set one pressure, read the applied pressures, vent: python examples/talk_to_the_board.py [PORT]

Without PORT the firmware compiled for this computer is the board. Turn the air off before you use a real board.
"""

import sys
import time
from contextlib import ExitStack

import numpy as np

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import CHANNELS


def main() -> None:
    robot = robot_file.load("pneumatic-3")
    with ExitStack() as exits:
        port = sys.argv[1] if len(sys.argv) > 1 else exits.enter_context(EmulatedBoard("native")).port
        board = exits.enter_context(Board.open(port, robot.serial.baud))
        print("board:", board.hello)
        board.arm(robot)
        pressures_bar = np.zeros(CHANNELS)
        pressures_bar[robot.chambers[0].channel] = 0.1
        for tick in range(3):  # a board that receives nothing for 0.3 s vents by itself
            board.set_pressures(tick, pressures_bar)
            time.sleep(0.1)
        board.check()  # raises an error if the board is lost or reports a fault
        print("applied, bar:", np.round(board.applied_bar, 3))
        print("vented:", board.vent())


if __name__ == "__main__":
    main()
