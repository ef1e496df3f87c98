"""Weights & Biases: offline into the run folder, refused where it cannot be had, and never in training's way."""

import logging
import socket
import sys
import threading
import time

import pytest

from imagine.core.errors import InputError
from imagine.train.run_folder import RunFolder
from imagine.train.settings import load_train_settings
from imagine.train.tracking.open import check_tracking
from imagine.train.tracking.settings import TrackingSettings, WandbSettings
from imagine.train.tracking.wandb_run import WandbTracker

OFFLINE = WandbSettings(mode="offline", project="test", tags=("a", "b"))


def test_offline_runs_are_kept_in_the_run_folder_and_name_no_host(tmp_path):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    overrides = ("tracking.wandb.mode=offline", f"run.root={tmp_path}", "run.name=mine")
    folder = RunFolder.create(load_train_settings(None, overrides))
    for step in range(3):
        folder.log(step, {"ppo/kl": 0.5, "ppo/value_loss": float("nan")})
    folder.close()
    [kept] = (tmp_path / "mine" / "wandb").glob("offline-run-*/run-*.wandb")
    deadline = time.monotonic() + 30.0
    while b"ppo/kl" not in (content := kept.read_bytes()):  # W&B's own process writes it when it gets to it
        assert time.monotonic() < deadline, "W&B wrote nothing"
        threading.Event().wait(0.05)
    assert b"critic_warmup_updates" in content
    assert b"ppo/value_loss" not in content
    assert str(tmp_path).encode() not in content
    if len(socket.gethostname()) > 4:  # shorter ones are parts of other words
        assert socket.gethostname().encode() not in content
    run_id = (tmp_path / "mine" / "wandb" / "run-id.txt").read_text().strip()
    assert run_id in kept.name


def test_a_failure_is_logged_once_and_training_goes_on(tmp_path, caplog):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    (tmp_path / "wandb").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        tracker = WandbTracker(OFFLINE, tmp_path, "run")
        for step in range(5000):  # more than the queue holds
            tracker.log(step, {"ppo/kl": 0.5})
        tracker.close()
    messages = [record.message for record in caplog.records if "W&B" in record.message]
    assert len([message for message in messages if message.startswith("W&B failed")]) == 1


def test_a_missing_package_is_named_with_its_remedy(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    settings = load_train_settings(None, ("tracking.wandb.mode=offline", f"run.root={tmp_path}"))
    with pytest.raises(InputError, match=r"wandb is not installed: pip install 'imagine-swarm\[wandb\]'"):
        RunFolder.create(settings)
    assert not list(tmp_path.iterdir())
    check_tracking(TrackingSettings())  # who does not ask for it needs no package


def test_nobody_is_asked_to_log_in_during_a_run(monkeypatch, tmp_path):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path))
    with pytest.raises(InputError, match="nobody is logged in: run 'wandb login' or set WANDB_API_KEY"):
        check_tracking(TrackingSettings(wandb=WandbSettings(mode="online")))
