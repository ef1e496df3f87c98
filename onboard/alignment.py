"""How far an estimated trajectory is from a reference, once the two are laid over each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def align_planar(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the estimated positions, rotated and shifted but not scaled to lie nearest to the reference.

    Both are `[n, 2]`, metres, matched point by point. Least squares: Umeyama 1991, with the scale held at one.
    """
    centre_e, centre_r = estimate.mean(axis=0), reference.mean(axis=0)
    u, _, vt = np.linalg.svd((reference - centre_r).T @ (estimate - centre_e))
    mirror = np.diag([1.0, np.sign(np.linalg.det(u @ vt))])
    aligned: NDArray[np.float64] = (estimate - centre_e) @ (u @ mirror @ vt).T + centre_r
    return aligned


def ate_rmse(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Return the absolute trajectory error, metres: root mean square distance after alignment (Sturm et al. 2012)."""
    off = align_planar(estimate, reference) - reference
    return float(np.sqrt((off**2).sum(axis=1).mean()))
