"""All settings of a study, as its YAML file holds them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from imagine.core.config import Settings, load_settings
from imagine.train.study.space import Distribution

STUDIES = Path(__file__).resolve().parent.parent / "studies"
"""Folder of the studies that come with the package."""

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
Metric = Literal["coverage", "t90", "contacts"]
_DECIDED_HERE = {
    "run.name": "trials are named by what they differ in",
    "run.root": "trials lie in the study's folder",
    "run.seed": "use seed and repeats",
    "run.threads": "use resources.cpus",
}


def _flat(keys: Any, before: str = "") -> Any:
    """Return nested mappings as one by dotted keys, the last of equal ones; distributions are left as they are."""
    if not isinstance(keys, dict):
        return keys
    flat: dict[str, Any] = {}
    for key, value in keys.items():
        if isinstance(value, dict) and not value.keys() <= Distribution.model_fields.keys():
            flat |= _flat(value, f"{before}{key}.")
        else:
            flat[f"{before}{key}"] = value
    return flat


class Variant(Settings):
    """Settings that go together, under a name."""

    name: str = Field(pattern=NAME, max_length=40)
    set: tuple[str, ...] = Field(default=(), description="overrides, key=value")


class Parameters(Settings):
    """What differs between trials: every value of the grid with every draw from the space."""

    grid: dict[str, list[Any]] = Field(default_factory=dict, description="values by setting, such as env.drones")
    space: dict[str, Distribution] = Field(default_factory=dict, description="distributions by setting")

    @model_validator(mode="before")
    @classmethod
    def _keys_in_one_piece(cls, data: Any) -> Any:
        """Take `grid: {env: {drones: […]}}`, as `--set parameters.grid.env.drones=[…]` gives it, as `env.drones`."""
        if not isinstance(data, dict):
            return data
        return {name: _flat(keys) if name in ("grid", "space") else keys for name, keys in data.items()}

    @field_validator("grid")
    @classmethod
    def _some_values_each(cls, grid: dict[str, list[Any]]) -> dict[str, list[Any]]:
        for key, values in grid.items():
            if not values:
                raise ValueError(f"{key} has no values; name at least one")
        return grid

    @model_validator(mode="after")
    def _each_key_once(self) -> Parameters:
        both = sorted(self.grid.keys() & self.space.keys())
        if both:
            raise ValueError(f"{both[0]} stands in grid and in space; keep one of them")
        return self


class Resources(Settings):
    """What a trial takes of the cluster while it runs."""

    cpus: int = Field(default=1, ge=1, description="also its threads")
    gpus: float = Field(default=0.0, ge=0.0, description="0.5: two trials share one")


class Stop(Settings):
    """When a trial has trained enough."""

    agent_steps: int | None = Field(
        default=None, ge=1, description="of imitation and PPO together, without rehearsal; none: as configured"
    )


class Asha(Settings):
    """Asynchronous successive halving (Li et al. 2020): the worse trials of those that came as far are stopped."""

    grace_agent_steps: int = Field(default=200_000, ge=1, description="no trial is stopped before")
    reduction_factor: float = Field(default=3.0, gt=1.0, description="one of so many goes on at each milestone")


class StudySettings(Settings):
    """A study: a base configuration, what differs between trials, how they are run and compared."""

    name: str = Field(pattern=NAME, max_length=60)
    root: str = Field(default="runs", min_length=1, description="folder of the study's folder")
    base: str = Field(default="default", min_length=1, description="a packaged training configuration, or a file")
    set: tuple[str, ...] = Field(default=(), description="overrides of all trials, key=value")
    variants: tuple[Variant, ...] = ()
    parameters: Parameters = Parameters()
    search: Literal["grid", "random", "asha"] = "grid"
    samples: int = Field(default=1, ge=1, le=10_000, description="draws from the space")
    repeats: int = Field(default=1, ge=1, le=1000, description="trials of each combination, with seeds of their own")
    seed: int = Field(default=0, ge=0, description="of the first repeat, and of the draws")
    metric: Metric = Field(default="coverage", description="what ASHA and the summary rank by, a mean over levels")
    mode: Literal["max", "min"] | None = Field(default=None, description="none: the better way for the metric")
    asha: Asha = Asha()
    stop: Stop = Stop()
    resources: Resources = Resources()
    max_concurrent: int | None = Field(default=None, ge=1, description="trials at once; none: what there is room for")
    max_failures: int = Field(default=3, ge=0, description="times that a trial whose worker died is taken up again")
    time_limit_s: float | None = Field(default=None, gt=0.0, description="a trial ends with the update that passes it")
    silent_s: float = Field(default=1800.0, ge=10.0, description="a worker that reports nothing for so long is ended")

    @model_validator(mode="after")
    def _search_and_space_agree(self) -> StudySettings:
        if self.search == "grid" and self.parameters.space:
            raise ValueError("search: a grid draws nothing from parameters.space; say random or asha")
        if self.samples > 1 and not self.parameters.space:
            raise ValueError("samples: there is no parameters.space to draw from; use repeats for more seeds")
        names = [variant.name for variant in self.variants]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"variants: two are called {name}")
        return self

    @model_validator(mode="after")
    def _leaves_out_what_the_study_decides(self) -> StudySettings:
        overrides = [*self.set, *(text for variant in self.variants for text in variant.set)]
        keys = [text.partition("=")[0].strip() for text in overrides]
        for key in [*keys, *self.parameters.grid, *self.parameters.space]:
            if key in _DECIDED_HERE:
                raise ValueError(f"{key} cannot be set by a study: {_DECIDED_HERE[key]}")
        return self

    @property
    def better(self) -> Literal["max", "min"]:
        """Which way the metric is better."""
        return self.mode or ("max" if self.metric == "coverage" else "min")

    @property
    def folder(self) -> Path:
        """The study's folder, absolute: trials run elsewhere."""
        return (Path(self.root) / self.name).absolute()


def load_study_settings(file: Path, overrides: Sequence[str] = ()) -> StudySettings:
    """Read a study: a YAML file, or the name of a packaged one (`paradigms`).

    A `base` that is a file beside the study's is taken from there. Raises InputError with file, line and key.
    """
    packaged = STUDIES / f"{file.name}.yaml"
    if not file.exists() and file.parent == Path() and packaged.exists():
        file = packaged
    settings = load_settings(StudySettings, file, overrides)
    beside = file.parent / settings.base
    return settings.model_copy(update={"base": str(beside)}) if beside.is_file() else settings
