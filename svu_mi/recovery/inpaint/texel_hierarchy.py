"""Texels as filling sees them: places, connected pieces, known values, and coarser groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.capture.mesh import unit_vectors
from svu_mi.geometry.neighbors import connected, means, squares_of, sums
from svu_mi.geometry.texels import Texels
from svu_mi.recovery.inpaint.fill_result import SUREST
from svu_mi.recovery.uncertainty.gmrf import FEWER, Smoother
from svu_mi.recovery.uncertainty.texture_field import TextureField

APART = 1e3  # distance between pieces that are not to be mixed up, in extents of the object


@dataclass(frozen=True)
class Pieces:
    """T texels of an object.

    Attributes:
        point: (T, 3) about the middle of its bounding box, in units of its diagonal.
        normal: (T, 3) unit.
        piece: (T,) int64, which connected piece of the surface each is of.
    """

    point: np.ndarray
    normal: np.ndarray
    piece: np.ndarray

    @staticmethod
    def of(texels: Texels, around: Sequence[Any]) -> Pieces:
        """Take texels and their neighbours (``Neighbors.around``)."""
        position, normal = (np.array(x, np.float64).T for x in (texels.position, texels.normal))
        return Pieces(centred(position), normal, connected(around))

    @cached_property
    def middle(self) -> np.ndarray:
        """(T, 3), the middle of the bounding box of each texel's piece."""
        order = np.argsort(self.piece, kind="stable")
        starts = np.flatnonzero(np.diff(self.piece[order], prepend=-1))
        low, high = (end.reduceat(self.point[order], starts) for end in (np.minimum, np.maximum))
        return np.asarray((low + high)[self.piece] / 2)

    def grouped(self, owner: np.ndarray) -> Pieces:
        """Return groups of texels of one piece each, by the group (T,) that every texel is of."""
        point, normal = (sums(table.T, owner).T for table in (self.point, self.normal))
        first = np.unique(owner, return_index=True)[1]
        size = np.bincount(owner)[:, None]
        return Pieces(point / size, unit_vectors(normal), self.piece[first])

    def apart(self, places: np.ndarray) -> np.ndarray:
        """Return places (T, d) with another column, by which pieces are far from each other."""
        return np.concatenate([places, APART * self.piece[:, None]], axis=1)


def centred(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) about the middle of their bounding box, in units of its diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)


ENOUGH = 2**16  # texels that guesses are tried on: of more, groups of neighbours


@dataclass(frozen=True)
class Ground:
    """T texels, or groups of them, some of which are known.

    Attributes:
        values: (N, T), of groups their mean.
        weights: (N, T), precisions of these, where they are known.
        single: (N, T), the values of one texel of each group: errors are those of texels, whose
            values differ by more than those of means.
        known: (T,) bool; of others, no values are looked at.
        size: (T,), of how many texels each is.
        square: (T, 2) int64, row and column in the map.
        pieces: where they lie.
        smoother: the links between them.
    """

    values: np.ndarray
    weights: np.ndarray
    single: np.ndarray
    known: np.ndarray
    size: np.ndarray
    square: np.ndarray
    pieces: Pieces
    smoother: Smoother

    @staticmethod
    def of(field: TextureField, known: np.ndarray) -> Ground:
        """Take the texels of a field, of which some, (T,) bool, are known."""
        weights = 1 / np.maximum(field.deviation, SUREST) ** 2
        square = squares_of(field.texels)
        pieces = Pieces.of(field.texels, field.smoother.around)
        return Ground(
            field.values, weights, field.values, known, np.ones(len(known)), square, pieces,
            field.smoother,
        )  # fmt: skip

    def without(self, hidden: np.ndarray) -> Ground:
        """Return the same with some texels, (T,) bool, that are not known."""
        return replace(self, known=self.known & ~hidden)

    @property
    def count(self) -> int:
        """T."""
        return len(self.known)

    @property
    def many(self) -> bool:
        """Whether there are more texels than it takes, and groups of them are fewer; they are not
        where known ones lie here and there."""
        return self.count > ENOUGH and self.halved[0].count < FEWER * self.count

    @property
    def small(self) -> Ground:
        """The same of groups, of groups of groups, and so on, until these are not too many."""
        return self.halved[0].small if self.many else self

    @cached_property
    def halved(self) -> tuple[Ground, np.ndarray]:
        """Groups of neighbours in squares of 2 x 2, of which all are known or none; and the group
        of every texel, (T,) int64."""
        square, own = self.square // 2, np.arange(self.count)
        alike = np.concatenate([square, self.known[:, None]], axis=1)
        columns = [np.array(column, np.int64) for column in self.smoother.around]
        owner = connected([
            np.where((alike[column] == alike).all(axis=1), column, own) for column in columns
        ])  # fmt: skip
        first = np.unique(owner, return_index=True)[1]
        values, weights = means(self.values, self.weights, owner)
        smoother = self.smoother.halved(owner, weights, values)
        coarse = Ground(
            values, weights, self.single[:, first], self.known[first],
            np.bincount(owner, self.size), square[first], self.pieces.grouped(owner), smoother,
        )  # fmt: skip
        return coarse, owner
