"""What the diagnosis is handed: data with covariance, a prediction, and what might be missing from it.

Nothing here knows an instrument. Data come in blocks (one recording of the instrument: an exposure, a pointing); blocks
are independent given the parameters; blocks of one group (a setting) share what was set by hand and leave together
when predictions are tested on data that were not fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = Mapping[str, float]
"""Parameter name → value in the parameter's unit; what is left out is 0."""


@dataclass(frozen=True)
class Parameter:
    """A number the prediction depends on; 0 is the simulation in doubt.

    Attributes
    ----------
    name : str
        Unique within the problem: ``s1.mirror_axis_1``, ``bow_z``.
    unit : str
        Of its value, everywhere.
    sigma : float
        Prior 1 sigma about 0 in that unit; of an effect's amplitude half of its plausible cap.
    scaled : bool
        A setting error: its prior sigma carries the setting scale, which is fitted.
    one_sided : bool
        Physical only where ≥ 0.
    power : int
        The data respond to value**power; 2 where a width is added in quadrature, which is invisible to a
        derivative at 0.
    blocks : tuple of int, or None
        Blocks it acts on; None: all.
    grid : tuple of float
        Not empty for a shape parameter (a place, a width, a period): the values at which the effect is screened. Its
        prior is uniform over their range; it has no effect on its own. ``value 0`` then has no meaning.
    """

    name: str
    unit: str
    sigma: float
    scaled: bool = False
    one_sided: bool = False
    power: int = 1
    blocks: tuple[int, ...] | None = None
    grid: tuple[float, ...] = ()


def fit_value(parameter: Parameter, value: float) -> float:
    """The number the data respond to: value**power."""
    return value**parameter.power


def value_of(parameter: Parameter, fit: float) -> float:
    """The value of a number that the data respond to; what has a power is never below 0."""
    return float(max(fit, 0.0) ** (1 / parameter.power)) if parameter.power > 1 else float(fit)


@dataclass(frozen=True)
class Effect:
    """A named piece of physics that the simulation may lack.

    Attributes
    ----------
    name, element : str
    parameters : tuple of Parameter
        All amplitudes, then the shape parameters.
    says, remedy : str
        One sentence of physics; one of what to do about it.
    random_field : bool
        The amplitudes are draws of one population whose sigma is itself unknown (at most ``sigma``): it is
        integrated over.
    whole : bool
        Present as a whole or not at all: where it is there, its amplitudes are near 1. Several such effects may need
        each other.
    """

    name: str
    element: str
    parameters: tuple[Parameter, ...]
    says: str = ""
    remedy: str = ""
    random_field: bool = False
    whole: bool = False


@dataclass(frozen=True)
class Attachment:
    """An unknown function of one element's own coordinate, as a linear basis whose prior is a Gaussian process.

    Attributes
    ----------
    name : str
        Unique: ``camera.pixel``.
    element, coordinate, unit : str
        ``camera``, ``image row``, unit of the coordinate.
    basis : (n, K)
        Change of every datum per unit of each coefficient, at the stated parameters.
    knots : (K, d)
        Where in the coordinate each coefficient sits; the covariance of two falls with the distance of their knots.
    component : (K,) int
        Coefficients of different components (shift in y, shift in z) are independent.
    sigma : float
        Largest plausible rms of the function.
    lengths : tuple of float
        Length scales that the Gaussian process may have, in the coordinate.
    position : (n, d)
        The coordinate of every datum; nan where it has none.
    axes, parts : tuple of str
        What a law calls the d directions of the coordinate, and the components where there are several.
    """

    name: str
    element: str
    coordinate: str
    unit: str
    basis: Array
    knots: Array
    component: NDArray[np.intp]
    sigma: float
    lengths: tuple[float, ...]
    position: Array
    axes: tuple[str, ...]
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class NextRecording:
    """A recording or observable that could be had next, as what it would measure, linearised at the stated setting.

    Attributes
    ----------
    kind : str
        "recording" or "observable".
    what : str
        A sentence for the person who would take it.
    covariance : (m, m)
        Of the data it would give.
    nuisance : mapping of str to (m,)
        Derivative by nuisance parameters; those of new names (a new setting) have ``priors``.
    priors : mapping of str to Parameter
        Of the nuisances that it brings along.
    effect : mapping of str to (m,)
        Derivative by the catalogue's amplitudes (by value**power).
    """

    kind: str
    what: str
    covariance: Array
    nuisance: Mapping[str, Array]
    priors: Mapping[str, Parameter]
    effect: Mapping[str, Array]


@dataclass(frozen=True)
class Problem:
    """Data, their noise, the prediction, and the hypotheses.

    Attributes
    ----------
    data : (n,)
        Block after block.
    block : (n,) int
        Number of the block of each datum, growing.
    kind : (n,) str
        Observable of each datum; noise is estimated for each kind apart.
    position : (n,)
        Where along its trace a datum sits (mm, or any length along which neighbours are correlated).
    stretch : (n,) int
        Data of one block with the same number form one line of neighbours (a ridge, a row); -1: no neighbours.
    covariance : tuple of (n_b, n_b)
        Of each block's data.
    names, groups : tuple of str
        Of the blocks, and the setting each belongs to.
    nuisances : tuple of Parameter
    catalogue : tuple of Effect
    predict : callable
        predict(values, block) → (n_b,) of the block. Must be a pure function of picklable arguments. Where it has an
        attribute ``many``, it also takes a list of values and one of their blocks, and gives the list of their
        predictions; call it by `linear.predictions`, which makes use of that. ``slopes``, a mapping of names to (n,),
        are derivatives that are the same everywhere and need no differences.
    attachments : tuple of Attachment
    next_recordings : callable or None
        Called only when something is open: gives what could be recorded next.
    stated : bool
        Whether somebody stated the sigma of the scaled nuisances: a name that asks for errors several times as large is
        then not said. False where they are a guess.
    spread : callable
        ``map`` for independent pieces of work, predictions above all; a pool's ``map`` uses more cores. What it is
        called with can be pickled if ``predict`` can.
    """

    data: Array
    block: NDArray[np.intp]
    kind: NDArray[np.str_]
    position: Array
    stretch: NDArray[np.intp]
    covariance: tuple[Array, ...]
    names: tuple[str, ...]
    groups: tuple[str, ...]
    nuisances: tuple[Parameter, ...]
    catalogue: tuple[Effect, ...]
    predict: Callable[[Values, int], Array]
    attachments: tuple[Attachment, ...] = ()
    next_recordings: Callable[[], tuple[NextRecording, ...]] | None = None
    stated: bool = True
    spread: Callable[..., Iterable[Any]] = field(default=map)

    @property
    def judged_forward(self) -> bool:
        """Whether nothing is known of the errors but their scatter, and nothing of what neighbours in time share: then
        models are judged by what they predict of another time (`forward`)."""
        return not self.stated and not any(p.scaled for p in self.nuisances)

    @cached_property
    def error_kinds(self) -> tuple[NDArray[np.bool_] | slice, ...]:
        """Data whose errors have one unknown size: all, or those of each kind where nobody states the errors."""
        return (slice(None),) if self.stated else tuple(self.kind == k for k in np.unique(self.kind))

    @cached_property
    def _edges(self) -> list[int]:
        return [int(e) for e in np.searchsorted(self.block, np.arange(len(self.names) + 1))]

    def rows(self, block: int) -> slice:
        """Where a block's data lie."""
        return slice(self._edges[block], self._edges[block + 1])
