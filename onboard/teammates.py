"""What the mesh says of the peers, as the policy's observation takes it."""

from __future__ import annotations

import numpy as np

from imagine.core.peer_poses import PeerPoses
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.peers import Peer
from imagine.onboard.ladder import Decider

_EXPLORING = frozenset({Decider.POLICY.value, Decider.FRONTIER.value, Decider.HOLD.value})


def peer_poses(mesh: MeshNode | None, now: float) -> tuple[PeerPoses, PeerPoses]:
    """Return the drones that were ever heard and said where they are, and those of them that say they explore.

    Only the latter leave visits: no policy was trained among drones that wait on the ground. Nobody is known without
    mesh, nor under the protocol `off`, which trains drones that tell each other nothing.
    """
    if mesh is None or mesh.settings.protocol == "off":
        return PeerPoses.none(), PeerPoses.none()
    told = [peer for _, peer in sorted(mesh.peers(now).items()) if peer.id != GROUND]  # as the twin numbers them
    return _of(told), _of([peer for peer in told if peer.status is not None and peer.status.ladder in _EXPLORING])


def _of(peers: list[Peer]) -> PeerPoses:
    placed = [(peer.pose, peer.age_s) for peer in peers if peer.pose is not None]
    return PeerPoses(
        np.array([pose[:2] for pose, _ in placed], np.float64).reshape(-1, 2),
        np.array([age_s for _, age_s in placed], np.float64),
    )
