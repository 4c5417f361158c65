"""Smooth random functions as sums of cosines with random frequencies."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Field:
    """Zero-mean, nearly Gaussian random function with the correlation exp(-(d / c)²).

    It is defined everywhere, has all derivatives and needs no grid.

    Attributes:
        frequency: Angular frequencies, rad per unit of the argument.
        phase: Phases, rad.
        amplitude: Amplitude of each cosine; the standard deviation times sqrt(2 / k).

    Source: Rahimi and Recht 2007, random Fourier features of the squared-exponential kernel.
    """

    frequency: Float[np.ndarray, "k d"]
    phase: Float[np.ndarray, "k"]
    amplitude: float

    def along(self, x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Values of a field of one argument."""
        return self.amplitude * np.cos(np.outer(x, self.frequency[:, 0]) + self.phase).sum(axis=1)

    def over(self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n m"]:
        """Values of a field of two arguments on the grid of `x` and `y`."""
        a = np.outer(x, self.frequency[:, 0]) + self.phase
        b = np.outer(y, self.frequency[:, 1])
        return self.amplitude * (np.cos(a) @ np.cos(b).T - np.sin(a) @ np.sin(b).T)


def draw_field(rng: np.random.Generator, sigma: float, correlation: float, dims: int = 1, terms: int = 96) -> Field:
    """Draw a field.

    Args:
        rng: Source of randomness.
        sigma: Standard deviation of the values.
        correlation: Correlation length c, where the correlation has fallen to 1/e, in the unit of the argument.
        dims: Number of arguments.
        terms: Number of cosines.
    """
    frequency = rng.normal(0.0, np.sqrt(2.0) / correlation, size=(terms, dims))
    return Field(frequency, rng.uniform(0.0, 2.0 * np.pi, terms), sigma * np.sqrt(2.0 / terms))
