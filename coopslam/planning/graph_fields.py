"""Fields of a graph that somebody wrote, each checked as it is read, and matrices as text."""

from base64 import b64decode, b64encode
from binascii import Error as NotBase64
from collections.abc import Mapping
from typing import Any

import numpy as np

from coopslam.errors import BadInput, shown
from coopslam.se2 import is_covariance


class Fields:
    """Reads fields; every method raises BadInput, which begins with the file and names the field."""

    def __init__(self, where: str):
        self.where = where

    def bad(self, name: str, expected: str, got: Any) -> BadInput:
        """The error that a field is not what was expected; its message is one line."""
        return BadInput(f"{self.where}: {name}: {expected} expected, got {shown(got)}")

    def field(self, data: Any, key: str, name: str) -> Any:
        """data[key]; `name` is what the message calls data."""
        if not isinstance(data, Mapping):
            raise self.bad(name, "an object", data)
        if key not in data:
            raise BadInput(f"{self.where}: {name}.{key}: missing")
        return data[key]

    def numbers(self, data: Mapping, key: str, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """data[key] as an array of finite numbers."""
        value = self.field(data, key, name)
        try:
            numbers = np.array(value, dtype=float)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        if numbers.shape != shape or not np.isfinite(numbers).all():
            wanted = "a finite number" if not shape else f"{' x '.join(map(str, shape))} finite numbers"
            raise self.bad(f"{name}.{key}", wanted, value)
        return numbers

    def covariance(self, data: Mapping, key: str, name: str, size: int) -> np.ndarray:
        """data[key] as a (size, size) covariance."""
        cov = self.numbers(data, key, name, (size, size))
        if not is_covariance(cov, size):
            raise self.bad(f"{name}.{key}", "a symmetric matrix without negative eigenvalues", data[key])
        return cov

    def not_negative(self, data: Mapping, key: str, name: str) -> None:
        """data[key] is a number of zero or more."""
        if self.numbers(data, key, name, ()) < 0:
            raise self.bad(f"{name}.{key}", "zero or more", data[key])


def packed(cov: np.ndarray) -> str:
    """A symmetric (n, n) matrix as text: base64 of its lower triangle, row by row, as little-endian doubles."""
    return b64encode(cov[np.tril_indices(len(cov))].astype("<f8").tobytes()).decode("ascii")


def unpacked(text: str, size: int) -> np.ndarray:
    """The (size, size) matrix of `packed`. Raises ValueError when the text is not one."""
    try:
        numbers = np.frombuffer(b64decode(text, validate=True), "<f8")
    except (NotBase64, ValueError) as error:
        raise ValueError("not base64 of doubles") from error
    if len(numbers) != size * (size + 1) // 2:
        raise ValueError(f"{size * (size + 1) // 2} numbers expected, got {len(numbers)}")
    cov = np.zeros((size, size))
    cov[np.tril_indices(size)] = numbers
    return cov + np.tril(cov, -1).T
