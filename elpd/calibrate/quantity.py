"""A measured number with its standard error, or the reason why there is none."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, model_validator


class Quantity(BaseModel):
    """A value and one standard error, in ``unit``; or neither, and ``reason`` says why it could not be measured."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    value: float | None
    sigma: float | None
    unit: str = ""
    reason: str | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        known = self.value is not None
        if known != (self.sigma is not None) or known != (self.reason is None):
            raise ValueError("a quantity has a value and a sigma, or a reason")
        return self

    @classmethod
    def of(cls, value: float, sigma: float, unit: str = "") -> Quantity:
        """Return a measured quantity."""
        return cls(value=float(value), sigma=float(sigma), unit=unit)

    @classmethod
    def none(cls, reason: str, unit: str = "") -> Quantity:
        """Return one that could not be measured; *reason* completes "not measurable, because ..."."""
        return cls(value=None, sigma=None, unit=unit, reason=reason)

    def __str__(self) -> str:
        if self.value is None or self.sigma is None:
            return f"not measurable, because {self.reason}"
        return f"{self.value:.4g} ± {self.sigma:.2g} {self.unit}".rstrip()
