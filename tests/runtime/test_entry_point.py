"""How a console script ends, whatever happens to it and to its streams."""

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
        raise ModuleNotFoundError("No module named 'ours'", name="ours")
    elif what == "read":
        click.echo(repr(sys.stdin.read()))
    else:
        try:
            os.kill(os.getpid(), getattr(signal, what))
        finally:
            click.echo("cleared up")

entry(cli, goes_on=True)()
"""


def run(what: str, **streams) -> subprocess.CompletedProcess:
    told = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    return subprocess.run([sys.executable, "-c", SCRIPT, what], text=True, timeout=60, check=False, **told)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_it_in_order(name, code):
    # A suite that a script starts in the background ignores Ctrl-C, and so would its children.
    done = run(name, preexec_fn=lambda: signal.signal(getattr(signal, name), signal.SIG_DFL))
    assert (done.returncode, done.stdout) == (code, "cleared up\n")
    assert done.stderr.strip() == "modsoft-train: interrupted; the same command goes on"


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_what_nohup_ignores_stays_ignored():
    done = run("SIGHUP", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    assert (done.returncode, done.stdout, done.stderr) == (0, "cleared up\n", "")


def test_a_missing_package_names_its_extra_and_a_missing_module_of_ours_is_a_bug():
    done = run("missing")
    assert done.returncode == 69
    assert "extra 'train': pip install '.[train]'" in done.stderr
    assert done.stderr.count("\n") == 1
    assert run("bug").returncode == 70


def test_nobody_reads_the_output():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = run("lines", stdout=closed)
        assert (done.returncode, done.stderr) == (141, "")
        done = run("read", stdout=closed)  # so little that it goes out at the very end
        assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
@pytest.mark.parametrize("what", ["lines", "read"])
def test_a_full_output_is_one_line(what):
    with open("/dev/full", "w") as full:
        done = run(what, stdout=full)
    assert done.returncode == 73
    assert "No space left" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="closes file descriptors")
def test_streams_that_were_closed_before():
    for number in range(3):
        done = run("read", preexec_fn=lambda number=number: os.close(number))
        assert done.returncode == 0, done.stderr


def test_options_and_choices_of_earlier_versions_are_refused_with_the_new_name(capsys, monkeypatch):
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
