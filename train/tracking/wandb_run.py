"""Scalars for Weights & Biases, on a thread of their own: whatever happens to W&B, training goes on."""

from __future__ import annotations

import importlib.util
import logging
import math
import queue
import secrets
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imagine.core.errors import InputError
from imagine.train.tracking.settings import WandbSettings

logger = logging.getLogger(__name__)

CLOSE_S = 30.0
"""How long a run waits at its end for W&B to take the rest."""
_MOST_WAITING = 1000  # updates; more are dropped, for a server out of reach must not fill the memory
_Item = tuple[int, dict[str, float]] | dict[str, Any] | None


def check_wandb(settings: WandbSettings) -> None:
    """Check that W&B can be told at all. Raises InputError when the package or, for online runs, a login is missing."""
    if settings.mode == "off":
        return
    if importlib.util.find_spec("wandb") is None:
        raise InputError(
            f"tracking.wandb.mode is {settings.mode}, but the package wandb is not installed: "
            "pip install 'imagine-swarm[wandb]', or set it to off"
        )
    if settings.mode == "online":
        import wandb

        if not wandb.login(prompt=False):  # else W&B would ask on the terminal in the middle of a run
            raise InputError(
                "tracking.wandb.mode is online, but nobody is logged in: run 'wandb login' or set WANDB_API_KEY, "
                "or set it to offline and send the run later by 'wandb sync'"
            )


class WandbTracker:
    """Passes scalars on to a W&B run from a queue. The first failure is logged; what comes after it is dropped.

    `folder` is the run's: W&B keeps its files in `wandb/` there, and the id by which a resumed run is told to be the
    same one.
    """

    def __init__(self, settings: WandbSettings, folder: Path, name: str) -> None:
        self._settings, self._folder, self._name = settings, folder, name
        self._queue: queue.Queue[_Item] = queue.Queue(_MOST_WAITING)
        self._failed = threading.Event()
        self._dropped = 0
        self._thread = threading.Thread(target=self._work, name="wandb", daemon=True)
        self._thread.start()

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Queue the scalars of an update; never waits and never fails. Those that are not finite are left out."""
        self._put((step, {name: float(value) for name, value in scalars.items() if math.isfinite(value)}))

    def config(self, config: Mapping[str, Any]) -> None:
        """Queue the settings; never waits and never fails."""
        self._put(dict(config))

    def close(self) -> None:
        """Wait for the queue to be handed over, for CLOSE_S at most."""
        self._put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive() and not self._failed.is_set():
            logger.warning("W&B has not taken everything within %.0f s; the run folder has it all", CLOSE_S)
        if self._dropped:
            logger.warning("W&B was too slow for %d updates; the run folder has them", self._dropped)

    def _put(self, item: _Item) -> None:
        if self._failed.is_set():
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self._dropped += 1

    def _work(self) -> None:
        try:
            run = self._begin()
            while (item := self._queue.get()) is not None:
                if isinstance(item, dict):
                    run.config.update(item, allow_val_change=True)
                else:
                    step, scalars = item
                    run.log({"agent_steps": step, **scalars})
            run.finish()
        except Exception as error:  # whatever it is, it is W&B's and must not end the run
            self._failed.set()
            logger.warning("W&B failed, and is told no more of this run: %s: %s", type(error).__name__, error)

    def _begin(self) -> Any:
        """Open the W&B run; neither host, paths, code nor packages of this machine are told."""
        import wandb

        kept_id = self._folder / "wandb" / "run-id.txt"
        if not kept_id.exists():
            kept_id.parent.mkdir(parents=True, exist_ok=True)
            kept_id.write_text(secrets.token_hex(4) + "\n", "utf-8")
        online = self._settings.mode == "online"
        run = wandb.init(
            mode="online" if online else "offline",
            dir=str(self._folder),
            id=kept_id.read_text("utf-8").strip(),
            resume="allow" if online else None,
            project=self._settings.project,
            entity=self._settings.entity,
            group=self._settings.group,
            tags=list(self._settings.tags),
            name=self._name,
            settings=wandb.Settings(
                console="off",
                silent=True,
                disable_git=True,
                disable_code=True,
                host="undisclosed",
                program="imagine",
                x_disable_meta=True,
                x_disable_stats=True,
                x_disable_machine_info=True,
                x_save_requirements=False,
            ),
        )
        run.define_metric("agent_steps")
        run.define_metric("*", step_metric="agent_steps")  # a resumed run may go back to its checkpoint
        return run
