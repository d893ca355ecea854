"""docs/rig.md names every fault and every message of board and runtime, and only commands that exist."""

import ast
import importlib
import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest

from modsoft.runtime import safety
from modsoft.runtime.board.ports import MEGA_IDENTITIES
from modsoft.runtime.board.protocol import Fault, NackReason, ResetCause

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
SOURCES = [
    *sorted((ROOT / "runtime" / "board").glob("*.py")),
    *sorted((ROOT / "runtime" / "tracking").glob("*.py")),
    *(ROOT / "runtime" / f"{name}.py" for name in ("calibration/mounting", "devices", "loop", "safety", "shutdown")),
]
ERRORS = {"Tripped", "LostInRun", "ModelError", "ProtocolMismatch", "PortBusy", "DeviceAbsent"}
# `kind` and `missing` are variables with one of these errors; `_lose` ends the connection with a reason.
RAISED = ERRORS | {"kind", "missing", "_lose"}
LEAST = 10  # letters of a message that identify it


def table(title):
    """First column of the table below a heading: the names between commas."""
    [section] = re.findall(rf"### {title}\n(.*?)(?=\n##|\Z)", PAGE, re.DOTALL)
    rows = [re.split(r"(?<!\\)\|", line)[1].strip() for line in section.splitlines() if line.startswith("| ")]
    return rows[2:] if set(rows[1]) == {"-"} else rows[1:]


def names(title):
    return {name for row in table(title) for name in row.split(", ")}


def text_of(node):
    """The text of a literal, with "..." for a value."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
    return "..."


def messages():
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and node.args:
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if name in RAISED and isinstance(node.args[0], (ast.Constant, ast.JoinedStr)):
                    yield text_of(node.args[0])
            elif isinstance(node, ast.Assign) and getattr(node.targets[0], "attr", "") == "failure":
                if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
                    yield node.value.value


MESSAGES = sorted(set(messages()))


def test_table_has_every_fault_of_the_board():
    assert names("Faults of the board") == {fault.name for fault in Fault}


def test_table_has_every_refusal():
    assert names("Refusals of the board") == {reason.name.lower() for reason in NackReason}


def test_table_has_every_cause_of_a_reset():
    assert names("Resets of the board") == {cause.name for cause in ResetCause}


def test_table_has_every_status_of_a_frame():
    statuses = {value for name, value in vars(safety).items() if name.isupper() and isinstance(value, str)}
    assert names("Frames of the tracker that are not used") == statuses - {safety.GOOD}


def test_messages_are_read_from_the_sources():
    assert len(MESSAGES) > 40
    assert "no HELLO received" in MESSAGES


@pytest.mark.parametrize("message", MESSAGES)
def test_table_has_message(message):
    excerpts = [row.strip("`") for row in table("Messages of the runtime")]
    assert any(excerpt in message for excerpt in excerpts if is_specific(excerpt, message))


def test_table_has_no_message_that_does_not_exist():
    excerpts = [row.strip("`") for row in table("Messages of the runtime")]
    assert [excerpt for excerpt in excerpts if not any(excerpt in message for message in MESSAGES)] == []


def is_specific(excerpt, message):
    return len(re.sub(r"[^a-z]", "", excerpt.lower())) >= LEAST or excerpt == message


def commands():
    """The commands of the page, one a string."""
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).splitlines()
    return sorted({line for line in [*blocks, *re.findall(r"`([^`\n]+)`", PAGE)] if line.startswith("modsoft-")})


@pytest.mark.parametrize("command", commands())
def test_command_exists(command):
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    script, *arguments = shlex.split(command.partition(" > ")[0])
    module, _, _ = scripts[script].partition(":")
    group = importlib.import_module(module).cli
    if isinstance(group, click.Group) and arguments and arguments[0] in group.commands:
        group, arguments = group.commands[arguments[0]], arguments[1:]
    options = {option for parameter in group.params for option in parameter.opts} | {"--help"}
    assert {argument for argument in arguments if argument.startswith("--")} <= options


def test_udev_rule_has_every_board():
    rules = re.findall(r'idVendor}=="(\w+)", ATTRS{idProduct}=="([\w|]+)"', PAGE)
    listed = {(int(vendor, 16), int(product, 16)) for vendor, products in rules for product in products.split("|")}
    assert listed == MEGA_IDENTITIES
