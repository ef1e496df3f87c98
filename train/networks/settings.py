"""What the networks are made of."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from imagine.core.config import Settings
from imagine.core.contract import Paradigm
from imagine.train.networks.gaussian import LOG_STD_RANGE

Width = Annotated[int, Field(ge=1, le=1024)]
ViewKind = Literal["strided", "patch"]
LidarKind = Literal["dense", "conv1", "conv2"]
HeadKind = Literal["gaussian", "choice"]
ChoiceNoise = Literal["independent", "coherent"]
MemoryKind = Literal["none", "gru", "stack"]
EncoderKind = Literal["separate", "shared"]


class NetworkSettings(Settings):
    """Who sees what, what remembers, what encodes it, and how widely the untrained policy explores."""

    paradigm: Paradigm = Field(
        default="ctde", description="ctde: the critic also sees the level; dtde: nobody; ctce: actor and critic see all"
    )
    encoder: EncoderKind = Field(
        default="separate", description="shared: the critic reads the actor's features, and its loss shapes them"
    )
    head: HeadKind = Field(
        default="gaussian",
        description="gaussian: a mean action, drawn around; choice: one of the frontiers seen, and the way to it",
    )
    choice_noise: ChoiceNoise = Field(
        default="coherent",
        description="in training, of the head choice: drawn anew in every decision, or staying with a frontier a while",
    )
    choice_momentum: float = Field(
        default=0.0, ge=0.0, le=20.0,
        description="in flight, of the head choice: what the score of a frontier gains where the drone flies its way",
    )  # fmt: skip
    memory: MemoryKind = Field(
        default="none", description="of the actor: a gated recurrent unit, or the newest views through 3-D convolutions"
    )
    memory_size: Width = Field(default=128, description="numbers that the gated recurrent unit keeps")
    stack_frames: int = Field(default=4, ge=2, le=16, description="views that a stack holds, the present one included")
    views: ViewKind = Field(
        default="strided",
        description="of the actor: overlapping kernels of stride 2, or patches of 4 x 4 cells first, at a third of the "
        "cost",
    )
    lidar: LidarKind = Field(default="conv2", description="a dense layer, or one or two circular convolutions")
    view_channels: tuple[Width, ...] = Field(
        default=(16, 32, 32), min_length=2, max_length=5, description="of the actor's convolutions over views"
    )
    lidar_channels: Width = Field(default=16, description="of the actor's circular convolutions")
    hidden: int = Field(default=128, ge=8, le=1024)
    critic_views: ViewKind = Field(default="patch", description="of the critic; patches are enough to tell a value")
    critic_channels: tuple[Width, ...] = Field(
        default=(32, 32), min_length=2, max_length=5, description="of each of the critic's image encoders"
    )
    critic_lidar_channels: Width = 8
    log_std: float = Field(
        default=-1.2, ge=LOG_STD_RANGE[0], le=LOG_STD_RANGE[1], description="at the start, the same for all states"
    )
