# SPDX-License-Identifier: Apache-2.0
"""Elimination of one region: a dense front over its own variables and its separator.

Up the tree a region takes its own variables out and tells its parent what is left over the separator; down the tree
it is told the separator's solution and covariance, and gives back those of its own variables. All is exact: nothing is
dropped or approximated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numba import njit

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray


class NotDetermined(ValueError):
    """The normal equations do not determine all variables."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """The marginal information (s, s) of a region over its separator, and the gradient (s,) there."""

    information: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, eq=False)
class Front:
    """Factor of a region's own variables.

    lower (o, o): Cholesky factor; cross (o, s): ``lower^-1`` times the information between own variables and separator;
    gradient (o,): ``lower^-1`` times the gradient.
    """

    lower: FloatArray
    cross: FloatArray
    gradient: FloatArray


def eliminate(information: FloatArray, gradient: FloatArray, own: int) -> tuple[Front, Reduced]:
    """Take the first ``own`` scalars out of dense normal equations (n, n).

    Raises
    ------
    NotDetermined
        If the information of the own scalars is not positive definite.
    """
    try:
        lower = scipy.linalg.cholesky(information[:own, :own], lower=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise NotDetermined("the normal equations are singular: part of the map hangs on nothing") from error
    if not np.all(np.isfinite(lower)):
        raise NotDetermined("the normal equations are not finite")
    cross = scipy.linalg.solve_triangular(lower, information[own:, :own].T, lower=True, check_finite=False)
    known = scipy.linalg.solve_triangular(lower, gradient[:own], lower=True, check_finite=False)
    left = information[own:, own:] - cross.T @ cross
    return Front(lower, cross, known), Reduced(left, gradient[own:] - cross.T @ known)


def substitute(front: Front, separator: FloatArray) -> FloatArray:
    """Step (o,) of the own scalars, given that of the separator (s,)."""
    right = -(front.gradient + front.cross @ separator)
    return np.asarray(scipy.linalg.solve_triangular(front.lower, right, lower=True, trans=1, check_finite=False))


def joint_covariance(front: Front, separator: FloatArray) -> FloatArray:
    """Covariance (o + s, o + s) of own scalars and separator, given that of the separator (s, s)."""
    own, known = len(front.lower), len(separator)
    right = np.concatenate([np.eye(own), front.cross], axis=1)
    solved = scipy.linalg.solve_triangular(front.lower, right, lower=True, trans=1, check_finite=False)
    inverse, gain = solved[:, :own], solved[:, own:]
    out = np.empty((own + known, own + known))
    mixed = -gain @ separator
    out[:own, :own] = inverse @ inverse.T - mixed @ gain.T
    out[:own, own:], out[own:, :own], out[own:, own:] = mixed, mixed.T, separator
    return out


@njit(cache=True, nogil=True)
def add_local_maps(model, maps, chosen, R, t, points, row_ptr, rows, information, gradient):  # type: ignore[no-untyped-def]
    """Add the normal equations of the ``chosen`` (k,) local maps to dense ones, lower triangle.

    rows (row_ptr[-1],): the scalar of each row of each of their own equations (reference, poses, landmarks), or -1.
    """
    work = kernels.work_space(maps)
    for k in range(len(chosen)):
        H, g = kernels.local_normal_equations(model, chosen[k], maps, R, t, points, work)
        own = rows[row_ptr[k] : row_ptr[k + 1]]
        for i in range(len(own)):
            if own[i] < 0:
                continue
            gradient[own[i]] += g[i]
            for j in range(len(own)):
                if 0 <= own[j] <= own[i]:
                    information[own[i], own[j]] += H[i, j]


def linearized(
    model: int,
    maps: FlatMaps,
    chosen: IntArray,
    state: JoiningState,
    row_ptr: IntArray,
    rows: IntArray,
    size: int,
    damping: float,
) -> tuple[FloatArray, FloatArray]:
    """Dense normal equations (size, size) and gradient of the ``chosen`` maps at a state.

    The diagonal is ``1 + damping`` times what it is.
    """
    information, gradient = np.zeros((size, size)), np.zeros(size)
    state_arrays = state.rotations, state.translations, state.landmarks
    add_local_maps(model, maps, chosen, *state_arrays, row_ptr, rows, information, gradient)
    information += np.tril(information, -1).T
    information[np.diag_indices(size)] *= 1.0 + damping
    return information, gradient


def assembled(size: int, parts: list[tuple[IntArray, Reduced]]) -> tuple[FloatArray, FloatArray]:
    """Dense normal equations of a front (size, size) from what regions inside left, each at its scalars (s,)."""
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for at, reduced in parts:
        information[np.ix_(at, at)] += reduced.information
        gradient[at] += reduced.gradient
    return information, gradient
