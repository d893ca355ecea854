"""Exit codes and messages of console scripts, under signals, errors and closed streams."""

import os
import signal
import subprocess
import sys

import click
import pytest

from modsoft.runtime.entry_point import Choice, entry, renamed_option

SCRIPT = """
import os, signal, sys, click
from modsoft.runtime.entry_point import entry

@click.command("modsoft-train")
@click.argument("what")
def cli(what):
    if what == "lines":
        for _ in range(100000):
            click.echo("a line")
    elif what == "missing":
        raise ModuleNotFoundError("No module named 'torch'", name="torch.nn")
    elif what == "bug":
        raise ModuleNotFoundError("No module named 'own'", name="own")
    elif what == "read":
        click.echo(repr(sys.stdin.read()))
    else:
        try:
            os.kill(os.getpid(), getattr(signal, what))
        finally:
            click.echo("cleared up")

entry(cli, resumable=True)()
"""


def run(what: str, **streams) -> subprocess.CompletedProcess:
    options = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    return subprocess.run([sys.executable, "-c", SCRIPT, what], text=True, timeout=60, check=False, **options)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_signal_ends_the_command_orderly(name, code):
    # A test suite in the background of a script ignores Ctrl-C, and so do its children.
    done = run(name, preexec_fn=lambda: signal.signal(getattr(signal, name), signal.SIG_DFL))
    assert (done.returncode, done.stdout) == (code, "cleared up\n")
    assert done.stderr.strip() == "modsoft-train: interrupted; run the same command to resume"


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ignored_signal_stays_ignored():
    done = run("SIGHUP", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    assert (done.returncode, done.stdout, done.stderr) == (0, "cleared up\n", "")


def test_missing_package_names_its_extra_and_missing_own_module_is_a_bug():
    done = run("missing")
    assert done.returncode == 69
    assert "extra 'train': pip install '.[train]'" in done.stderr
    assert done.stderr.count("\n") == 1
    assert run("bug").returncode == 70


def test_closed_output_ends_without_a_message():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = run("lines", stdout=closed)
        assert (done.returncode, done.stderr) == (141, "")
        done = run("read", stdout=closed)  # written only when flushed at exit
        assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
@pytest.mark.parametrize("what", ["lines", "read"])
def test_full_output_is_one_line(what):
    with open("/dev/full", "w") as full:
        done = run(what, stdout=full)
    assert done.returncode == 73
    assert "No space left" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="closes file descriptors")
def test_streams_closed_before_the_start():
    for number in range(3):
        done = run("read", preexec_fn=lambda number=number: os.close(number))
        assert done.returncode == 0, done.stderr


def test_renamed_options_and_choices_are_refused_with_the_new_name(capsys, monkeypatch):
    @click.command("modsoft-train")
    @click.option("--kind", type=Choice(["new"], {"old": "new"}))
    @renamed_option("--before", "--now")
    def cli(kind):
        click.echo(kind)

    def ended(*arguments):
        monkeypatch.setattr(sys, "argv", ["modsoft-train", *arguments])
        with pytest.raises(SystemExit) as left:
            entry(cli)()
        return left.value.code, *capsys.readouterr()

    assert ended("--kind", "new") == (0, "new\n", "")
    assert ended("--kind", "old") == (2, "", "modsoft-train: old is now new; give new\n")
    assert ended("--before", "1") == (2, "", "modsoft-train: --before is now --now; give --now\n")
    assert ended("--kind", "other")[0] == 2
