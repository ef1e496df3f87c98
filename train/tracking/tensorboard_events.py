"""Scalars in event files, as TensorBoard reads them.

TensorBoard's own writer fills its files from a thread, which ends at the first error: what comes later waits in a
queue, and a full disk is noticed late or never. It also writes the host's name into the file's. So events are encoded
here, and an update's scalars are appended as one event; that takes less time than handing them to a thread one by one.
"""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from imagine.train.atomic_file import append_whole, write_atomically

_NAME = "events.out.tfevents.{:012d}.imagine"


class TensorBoardTracker:
    """Appends events to one file a session, named by the agent-steps at its start, so that files sort as they follow.

    A run that goes on from an earlier step drops the files that began later, and the new file's first event tells
    TensorBoard to forget steps from there on. Raises WorkError when a file cannot be written.
    """

    def __init__(self, folder: Path, start_step: int = 0) -> None:
        self.path = folder / _NAME.format(start_step)
        for later in folder.glob("events.out.tfevents.*.imagine"):
            if later.name > self.path.name:
                later.unlink()
        begin = _record(Event(wall_time=time.time(), file_version="brain.Event:2"))
        if start_step:
            session = SessionLog(status=SessionLog.START)
            begin += _record(Event(wall_time=time.time(), step=start_step + 1, session_log=session))
        write_atomically(self.path, lambda file: file.write_bytes(begin))

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Append one event that holds all scalars. Raises WorkError when the file cannot be written."""
        values = [Summary.Value(tag=name, simple_value=value) for name, value in scalars.items()]
        append_whole(self.path, _record(Event(wall_time=time.time(), step=step, summary=Summary(value=values))))

    def config(self, config: Mapping[str, Any]) -> None:
        """Append the settings as a text, shown under TEXT. Raises WorkError when the file cannot be written."""
        from torch.utils.tensorboard.summary import text

        shown = "".join(f"    {line}\n" for line in yaml.safe_dump(dict(config), sort_keys=False).splitlines())
        summary = text("config", shown)  # type: ignore[no-untyped-call]
        append_whole(self.path, _record(Event(wall_time=time.time(), summary=summary)))

    def close(self) -> None:
        """Do nothing: no file stays open between two events."""


def _record(event: Event) -> bytes:
    """Return an event as a record with its lengths and checksums."""
    buffer = io.BytesIO()
    RecordWriter(buffer).write(event.SerializeToString())
    return buffer.getvalue()
