"""`modsoft-calibrate`: how the sensors and actuators of a robot are mounted."""

from __future__ import annotations

import click

from modsoft.runtime.entry_point import entry


@click.group("modsoft-calibrate", context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.version_option(None, "-V", "--version", package_name="modsoft", prog_name="modsoft-calibrate")
def cli() -> None:
    """Measure a robot before its first run.

    The results are beside the robot file, in robot.calibration.toml; modsoft-runtime uses them. The file before is kept
    as robot.calibration.toml.backup.
    """


main = entry(cli)

if __name__ == "__main__":
    main()
