"""Rotations by the thousand: exponential, logarithm and cross-product matrices."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Vectors = Float[np.ndarray, "n 3"]
Matrices = Float[np.ndarray, "n 3 3"]


def exp(vector: Vectors) -> Matrices:
    """Matrices of the rotation vectors, rad."""
    return Rotation.from_rotvec(vector).as_matrix()


def log(matrix: Matrices) -> Vectors:
    """Rotation vectors of the matrices, rad, of length at most π."""
    return Rotation.from_matrix(matrix).as_rotvec()


def skew(vector: Vectors) -> Matrices:
    """Matrices that take the cross product with each vector from the left."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def inverse(matrix: Matrices) -> Matrices:
    """The turns back."""
    return np.swapaxes(matrix, -1, -2)


def apply(matrix: Matrices, vector: Vectors) -> Vectors:
    """Each vector turned by its matrix."""
    return np.einsum("nij,nj->ni", matrix, vector)
