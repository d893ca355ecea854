"""The runtime's own host side on an emulated MEGA in mid-run, for faults of board, cable and bootloader.

Run as a program, `python mega_in_run.py PORT...`, it drives the boards at these ports until it is killed, and prints a
line as soon as all of them are at `Host.BAR`.
"""

import contextlib
import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from stepped_port import SteppedPort

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.runtime import robot as robots
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.ports import open_port
from modsoft.runtime.board.protocol import State

CHECK_S = 0.005  # how often the real loop looks between two ticks


class Host:
    """Six chambers at `BAR`, a set-point every `PERIOD_S`.

    threaded: False leaves the port to the caller's thread, which may then take over the wire itself.
    """

    BAR = 0.35  # the most that the shipped robot allows: the longest way down
    PERIOD_S = 0.4
    ROBOT = robots.load("pneumatic-3")

    def __init__(self, port, threaded=True, clock=time.monotonic):
        self.port, self.threaded, self.clock = port, threaded, clock
        self.board = Board(port, "the emulated MEGA", clock, threaded)
        self.tick = 0
        self.due_s = clock()

    def start(self):
        """Arm, and go on until the board has said that every chamber is told `BAR`."""
        self.board.arm(self.ROBOT)
        self.go_on(3 * self.PERIOD_S)
        assert self.board.status.state == State.RUNNING
        assert min(self.board.applied_bar[:6]) == self.BAR

    def go_on(self, seconds):
        """The control loop for so long. Raises what `Board.check` raises, as soon as the loop can know."""
        until_s = self.clock() + seconds
        while (now_s := self.clock()) < until_s:
            self.board.check()
            if now_s >= self.due_s:
                self.tick += 1
                self.due_s = now_s + self.PERIOD_S
                self.board.set_pressures(self.tick, np.full(6, self.BAR))
            if self.threaded:
                time.sleep(max(0.0, min(self.due_s, until_s, now_s + CHECK_S) - now_s))
            else:
                self.board._line.pump()


@contextlib.contextmanager
def in_run(threaded=True):
    """(host, emulated board) in mid-run in real time, at a random phase of the period."""
    with EmulatedBoard("simavr") as emulated:
        emulated.send("sensors 20")
        host = Host(open_port(emulated.port, Host.ROBOT.serial.baud), threaded)
        try:
            host.start()
            host.go_on(random.uniform(0.0, Host.PERIOD_S))
            yield host, emulated
        finally:
            host.board._line.close()


@contextlib.contextmanager
def in_stepped_run():
    """(host, emulated board) in mid-run, at a random phase of the period, both on the board's own clock."""
    with EmulatedBoard("simavr", stepped=True) as emulated:
        emulated.send("sensors 20")
        host = stepped_host(emulated)
        try:
            host.start()
            host.go_on(random.uniform(0.0, Host.PERIOD_S))
            host.port.idle(random.uniform(1e-6, 2e-3))  # anywhere in a pass of the firmware
            yield host, emulated
        finally:
            host.port.close()


def stepped_host(emulated, name=""):
    """A host on the clock of a stepped board, connected; `name`: of its port where that is not its first one."""
    port = SteppedPort(emulated, name)
    return Host(port, threaded=False, clock=port.clock)


def inject(emulated, command, name="command"):
    """Give the board a command; its event `name`, and how long the trace was before it."""
    since = len(emulated.trace)
    emulated.send(command)
    return emulated.wait_for(lambda event: event["event"] == name, 5.0, since), since


def side_by_side(tries, attempt, at_once=5):
    """What `attempt(number)` returns, for every number below `tries`, several at once: a board is mostly idle."""
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(attempt, range(tries)))


def main(names):
    """Drive the boards at these ports for ever."""
    hosts = side_by_side(len(names), lambda number: Host(open_port(names[number], 250_000)), len(names))
    side_by_side(len(hosts), lambda number: hosts[number].start(), len(hosts))
    print("in run", flush=True)
    side_by_side(len(hosts), lambda number: hosts[number].go_on(3600.0), len(hosts))


if __name__ == "__main__":
    main(sys.argv[1:])
