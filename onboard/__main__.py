"""`python -m imagine.onboard SETTINGS.yaml`: fly one drone, without the command line's extras, so it starts fast."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from imagine.core.config import load_settings
from imagine.core.errors import ImagineError
from imagine.onboard.settings import DroneSettings


def main(arguments: list[str]) -> int:
    """Run the drone that the settings file describes; return the exit status."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if len(arguments) != 1:
        print("usage: python -m imagine.onboard SETTINGS.yaml", file=sys.stderr)
        return 2
    try:
        settings = load_settings(DroneSettings, Path(arguments[0]))
        from imagine.onboard.process import run_drone

        return run_drone(settings)
    except ImagineError as error:
        print(f"imagine: {error}", file=sys.stderr)
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
