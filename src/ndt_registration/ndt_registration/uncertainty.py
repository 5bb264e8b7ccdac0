"""How well a registration determines the pose: covariance from the scatter of the cells' pulls, and directions left
free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, skew


@dataclass(frozen=True)
class UncertaintyConfig(Config):
    """Covariance and degeneracy of a registration."""

    degeneracy: float = parameter(
        0.004,
        "least curvature of a determined direction over the largest, angles times the scale",
        minimum=0.0,
        maximum=1.0,
    )
    friction: float = parameter(
        2.0, "share of the curvature expected from errors of the normals alone that counts as none", minimum=0.0
    )
    free_sigma: float = parameter(1.0, "standard deviation given to a free direction, over the scale", minimum=0.0)
    inflation: float = parameter(2.5, "factor on the covariance of determined directions", minimum=0.01)
    sigma_floor: float = parameter(1e-4, "least standard deviation of any direction, over the scale", minimum=0.0)


class Uncertainty(NamedTuple):
    """Covariance (6, 6) of the pose error; unit directions (k, 6) that are not determined, rotations about the matched
    points.
    """

    covariance: FloatArray
    free: FloatArray


class Curvature(NamedTuple):
    """Second derivatives of the cost at the optimum (6, 6): exact, its semidefinite majorant, and what errors of
    normals feign.
    """

    hessian: FloatArray
    majorant: FloatArray
    friction: FloatArray


class Extent(NamedTuple):
    """Where the points are that were matched: centroid (3,) and root mean square distance from it, m."""

    centre: FloatArray
    radius: float


def sandwich(
    curvature: Curvature,
    pulls: FloatArray,
    extent: Extent,
    scale: float,
    fixed: npt.NDArray[np.bool_],
    config: UncertaintyConfig,
) -> Uncertainty:
    """Covariance ``H^-1 (sum g g') H^-1`` of an M-estimate whose errors are independent between blocks only (White
    1982).

    Neighbouring points share the errors of the cell they are matched with, so taking points as independent promises far
    too much. The gradients ``g`` of the blocks vanish in sum at the optimum; their scatter contains noise,
    discretisation and wrong matches alike.

    Parameters
    ----------
    curvature
        Of the cost at the optimum.
    pulls
        Gradient of the cost of each block, shape (b, 6).
    extent
        Rotations are taken about the centre of what was matched, and angles times its radius: only there can the
        curvatures of translations and rotations be compared (Zhang and Singh 2016 on degeneracy).
    scale
        Free directions get ``free_sigma`` times this, m.
    config
        Settings.
    fixed
        Components of the pose error that were held, shape (6,); their variance is that of the floor.
    """
    to_pose = np.eye(6)
    to_pose[:3, 3:] = skew(extent.centre) / extent.radius
    to_pose[3:, 3:] /= extent.radius
    H, M = to_pose.T @ curvature.hessian @ to_pose, to_pose.T @ curvature.majorant @ to_pose
    G = pulls @ to_pose
    H[fixed], H[:, fixed], M[fixed], M[:, fixed], G[:, fixed] = 0.0, 0.0, 0.0, 0.0, 0.0
    feigned = to_pose.T @ curvature.friction @ to_pose
    feigned[fixed], feigned[:, fixed] = 0.0, 0.0
    values, vectors = np.linalg.eigh(M - config.friction * feigned)
    held = np.abs(vectors[fixed]).sum(axis=0) > 0.5
    free = (values <= max(config.degeneracy * values[-1], 1e-6 * np.trace(feigned), 0.0)) & ~held
    known = vectors[:, ~free & ~held]
    covariance = (config.sigma_floor * scale) ** 2 * np.eye(6)
    if known.shape[1]:
        inverse = _inverse(known.T @ H @ known, known.T @ M @ known)
        scatter = known.T @ G.T @ G @ known * (len(pulls) / max(len(pulls) - 6, 1))
        covariance += config.inflation * known @ inverse @ scatter @ inverse @ known.T
    covariance += (vectors[:, free] * (config.free_sigma * scale) ** 2) @ vectors[:, free].T
    covariance = to_pose @ covariance @ to_pose.T
    return Uncertainty(0.5 * (covariance + covariance.T), vectors[:, free].T)


def _inverse(hessian: FloatArray, majorant: FloatArray) -> FloatArray:
    """Inverse of the exact curvature, or of the majorant where the exact one is (nearly) indefinite."""
    majorant = majorant + 1e-12 * np.trace(majorant) * np.eye(len(majorant))
    relative = np.linalg.eigvals(np.linalg.solve(majorant, hessian)).real
    return np.asarray(np.linalg.inv(hessian if relative.min() > _LEAST_RELATIVE_CURVATURE else majorant))


_LEAST_RELATIVE_CURVATURE = 0.05


def unknown(scale: float, config: UncertaintyConfig) -> FloatArray:
    """Covariance (6, 6) of a pose of which nothing is known: every direction free."""
    sigma = config.free_sigma * max(scale, 1.0)
    return np.diag(np.r_[np.full(3, sigma), np.full(3, config.free_sigma)] ** 2)


def direction_names(free: FloatArray) -> tuple[str, ...]:
    """Readable names of free directions (k, 6), such as ``translation along (0.00, 1.00, 0.00)``."""
    names = []
    for direction in free:
        translation, rotation = np.linalg.norm(direction[:3]), np.linalg.norm(direction[3:])
        kind, axis = (
            ("translation along", direction[:3]) if translation >= rotation else ("rotation about", direction[3:])
        )
        axis = axis / np.linalg.norm(axis)
        axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0) + 0.0
        names.append(f"{kind} ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})")
    return tuple(names)
