"""Gauss-Newton steps for a chain of knots: terms join knots that are near in time, so the normal matrix is a band.

A banded Cholesky factorisation is linear in the number of knots and has one order of operations: the same input gives
the same bytes, which general sparse or threaded solvers do not promise.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, solveh_banded

from scene.errors import FitError


class NormalEquations:
    """The normal equations of least squares over `n` knots of `size` unknowns each.

    Attributes:
        size: Unknowns a knot.
        reach: Largest distance in knots between two that one term joins.
    """

    def __init__(self, n: int, size: int, reach: int) -> None:
        self.size, self.reach = size, reach
        # scipy's lower form: entry (row, column) lies at [row - column, column].
        self._band = np.zeros((size * (reach + 1), n * size))
        self._right = np.zeros(n * size)
        self.cost = 0.0

    def add(
        self,
        residual: Float[np.ndarray, "m r"],
        first: Int[np.ndarray, " m"],
        jacobian_first: Float[np.ndarray, "m r s"],
        second: Int[np.ndarray, " m"] | None = None,
        jacobian_second: Float[np.ndarray, "m r s"] | None = None,
    ) -> None:
        """Adds terms already divided by their standard deviations.

        Args:
            residual: In standard deviations.
            first: Knot of each term.
            jacobian_first: Derivative of the residual by that knot's unknowns.
            second: A later knot of each term, where it joins two.
            jacobian_second: Derivative by that knot's unknowns.
        """
        self.cost += float(np.sum(residual**2))
        self._block(first, first, jacobian_first, jacobian_first)
        self._gradient(first, jacobian_first, residual)
        if second is not None and jacobian_second is not None:
            self._block(second, second, jacobian_second, jacobian_second)
            self._block(second, first, jacobian_second, jacobian_first)
            self._gradient(second, jacobian_second, residual)

    def _block(self, row: np.ndarray, column: np.ndarray, left: np.ndarray, right: np.ndarray) -> None:
        block = np.einsum("mra,mrb->mab", left, right)
        a, b = np.arange(self.size)[:, None], np.arange(self.size)[None, :]
        below = self.size * (row - column)[:, None, None] + a - b
        at = self.size * column[:, None, None] + b
        kept = below >= 0
        place = (below * self._band.shape[1] + at)[kept]
        self._band += np.bincount(place, block[kept], self._band.size).reshape(self._band.shape)

    def _gradient(self, knot: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> None:
        place = self.size * knot[:, None] + np.arange(self.size)
        value = np.einsum("mrs,mr->ms", jacobian, residual)
        self._right -= np.bincount(place.ravel(), value.ravel(), len(self._right))

    def solve(self, damping: float = 0.0) -> Float[np.ndarray, "n s"]:
        """The step that lowers the cost.

        Args:
            damping: Share of the diagonal added to it (Levenberg-Marquardt).

        Raises:
            FitError: Some unknown is not determined.
        """
        band = self._band.copy()
        band[0] *= 1.0 + damping
        try:
            return solveh_banded(band, self._right, lower=True, overwrite_ab=True).reshape(-1, self.size)
        except LinAlgError as error:
            raise FitError(f"the trajectory is not determined by what was measured ({error})") from error
