"""`python -m imagine.onboard SETTINGS.yaml`: fly one drone, without the command line's extras, so it starts fast.

With --tethered it loads its code first and waits for a line on standard input before it reads the settings; it lands
and ends when standard input does.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from imagine.core.errors import ImagineError


def main(arguments: list[str]) -> int:
    """Run the drone that the settings file describes; return the exit status."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if len(arguments) not in (1, 2) or arguments[1:] not in ([], ["--tethered"]):
        print("usage: python -m imagine.onboard SETTINGS.yaml [--tethered]", file=sys.stderr)
        return 2
    try:
        if arguments[1:]:
            from imagine.onboard import tether

            tether.load_code()
            if not tether.wait_for_settings():
                return 0
            tether.end_with_standard_input()
        from imagine.core.config import load_settings
        from imagine.onboard.process import run_drone
        from imagine.onboard.settings import DroneSettings

        return run_drone(load_settings(DroneSettings, Path(arguments[0])))
    except ImagineError as error:
        print(f"imagine: {error}", file=sys.stderr)
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
