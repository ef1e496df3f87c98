"""Recordings of real LiDARs, one file per format; `open_recording` tells them apart by what is in them."""

from imagine.onboard.recordings.open import FORMATS, open_recording
from imagine.onboard.recordings.record import Record, Recording

__all__ = ["FORMATS", "Record", "Recording", "open_recording"]
