"""What a page takes from the files of a finished folder, checked before anything is drawn: one sentence, or none."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from benchsim.bench.errors import BenchsimError

Number = Annotated[float, Field(ge=-1e30, le=1e30)]


def _in_utf_8(text: str) -> str:
    text.encode()
    return text


Text = Annotated[str, AfterValidator(_in_utf_8)]
Numbers = list[Number | None]
Points = list[Annotated[list[Number], Field(min_length=2, max_length=2)]]
Chance = Annotated[float, Field(ge=0, le=1)]
Side = Annotated[int, Field(ge=1, le=100_000)]


class Form(BaseModel):
    """Keys that a page shows; others are passed over."""

    model_config = ConfigDict(strict=True)


class _Size(Form):
    value: Number
    sigma: Number | None
    unit: Text


class _Moved(_Size):
    how: Text


class _Prior(Form):
    sigma: Number
    unit: Text


class _Residuals(Form):
    before: Numbers
    after: Numbers
    held_out_before: Numbers
    held_out_after: Numbers


class _Most(Form):
    s_mm: list[Number] | None = None
    before: Numbers = Field(default_factory=list)
    after: Numbers = Field(default_factory=list)
    held_out_before: Numbers = Field(default_factory=list)
    held_out_after: Numbers = Field(default_factory=list)
    sigma: list[Number] = Field(default_factory=list)
    sigma_alone: list[Number] = Field(default_factory=list)
    at_px: Points | None = None
    before_px: Points = Field(default_factory=list)
    after_px: Points = Field(default_factory=list)

    @model_validator(mode="after")
    def _as_long(self) -> _Most:
        if self.s_mm is None and self.at_px is None:
            raise ValueError("neither s_mm nor at_px is there")
        along = (self.before, self.after, self.held_out_before, self.held_out_after, self.sigma, self.sigma_alone)
        if self.s_mm is not None and (not self.s_mm or any(len(x) != len(self.s_mm) for x in along)):
            raise ValueError("its lists are not all as long as s_mm")
        if self.at_px is not None and not len(self.at_px) == len(self.before_px) == len(self.after_px):
            raise ValueError("at_px, before_px and after_px are not of one length")
        return self


class _Exposure(Form):
    exposure: Text
    setting: Text
    photograph: Text | None
    size_px: Annotated[list[Side], Field(min_length=2, max_length=2)]
    same: bool
    measured_px: Points
    before_px: Points
    after_px: Points
    s_mm: Annotated[list[Number], Field(min_length=1)]
    residual_mm: _Residuals
    sigma_mm: Numbers
    sigma_alone_mm: Numbers
    profiles: Annotated[int, Field(ge=1, le=10**9)] | None = None
    departures: dict[Text, _Size] = Field(default_factory=dict)
    most: _Most | None = None

    @model_validator(mode="after")
    def _as_long(self) -> _Exposure:
        r = self.residual_mm
        along = (r.before, r.after, r.held_out_before, r.held_out_after, self.sigma_mm, self.sigma_alone_mm)
        if any(len(x) != len(self.s_mm) for x in along):
            raise ValueError("its lists are not all as long as s_mm")
        if not len(self.measured_px) == len(self.before_px) == len(self.after_px):
            raise ValueError("measured_px, before_px and after_px are not of one length")
        return self


class _Known(Form):
    name: Text
    element: Text
    says: Text


class _States(Form):
    before: Text
    after: Text


class Page(Form):
    """``page.json``."""

    title: Text
    settings: Annotated[int, Field(ge=0, le=10**9)]
    instrument: Text = "bench"
    unit: Text = "mm"
    states: _States
    catalogue: list[_Known]
    exposures: list[_Exposure]
    moves: dict[Text, _Moved] = Field(default_factory=dict)
    priors: dict[Text, _Prior] = Field(default_factory=dict)
    most: Literal["w", "f", "g", "m"] | None = None

    @model_validator(mode="after")
    def _of_the_kind(self) -> Page:
        key = "at_px" if self.most == "m" else "s_mm"
        if self.most and any(x.most and getattr(x.most, key) is None for x in self.exposures):
            raise ValueError(f"most: {self.most!r} needs {key}")
        return self


def _with_own(versions: dict[str, str]) -> dict[str, str]:
    if "benchsim" not in versions:
        raise ValueError("benchsim's own is missing")
    return versions


class Stamp(Form):
    """``benchsim.json``."""

    command: Text
    written: Text
    versions: Annotated[dict[Text, Text], AfterValidator(_with_own)]
    inputs: dict[Text, Text]
    defaults_used: list[Text]


class _Pooled(Form):
    before: Number
    after: Number


class _Seen(Form):
    exposure: Text


class Pixels(Form):
    """``pixels.json``."""

    exposures: list[_Seen]
    pooled: _Pooled


class _Split(Form):
    what: Text
    separation_sigma: Number | None


class _Found(Form):
    name: Text
    element: Text
    confidence: Text
    probability: Chance
    says: Text
    parameters: dict[Text, _Size]


class _Class(Form):
    members: list[list[Text]]
    probability: Chance
    split_by: _Split | None
    sizes: list[dict[Text, _Size]] = Field(default_factory=list)
    stated: bool | None = None


class _Limit(Form):
    parameter: Text
    five_sigma: Number | None
    unit: Text
    reachable: bool


class _Fit(Form):
    rms: dict[Text, _Pooled]


class Diagnosis(Form):
    """``diagnosis.json``."""

    verdict: Text
    against: Text
    effects: list[_Found]
    classes: list[_Class]
    probability: dict[Text, Chance]
    limits: dict[Text, _Limit]
    fit: _Fit
    next: list[_Split]
    remarks: list[Text]
    notes: list[Text]
    lost: list[Text]
    pulls: dict[Text, Number | None]


class _Distance(Form):
    rms_mm: Number
    rms_mrad: Number
    p_value: Chance


class _Alone(Form):
    after: _Distance


class _Trace(Form):
    exposure: Text
    before: _Distance
    after: _Distance
    vector_alone: _Alone
    agrees: bool | None
    polygon_mm: Number | None
    radius_mm: Number | None
    radius_own_aim_mm: Number | None
    pulls: dict[Text, Number | None]


class Validation(Form):
    """``validation.json``."""

    level: Chance
    exposures: list[_Trace]
    lost: list[Text]


def checked(form: type[Form], path: Path, value: Any) -> Any:
    """The value, if it has a form; None and an empty mapping stand for a file that is not there.

    Raises
    ------
    BenchsimError
        With file, key and mend.
    """
    if value is None or value == {}:
        return value
    try:
        form.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the file"
        said = first["msg"].removeprefix("Value error, ")
        raise BenchsimError(
            f"{path}: {key[:100]}: {said[0].lower()}{said[1:]}; write the folder anew with this benchsim"
        ) from None
    return value
