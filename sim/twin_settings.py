"""What can be set about a twin that is served: how its airframes answer, what its LiDARs see, how far radios reach."""

from __future__ import annotations

from imagine.core.config import Settings
from imagine.sim.dynamics import DynamicsSettings
from imagine.sim.lidar_model import LidarModel
from imagine.sim.radio import RadioSettings


class TwinSettings(Settings):
    """How far a served twin is from an ideal one; the defaults are those of training."""

    dynamics: DynamicsSettings = DynamicsSettings()
    sensing: LidarModel = LidarModel()
    radio: RadioSettings = RadioSettings()
