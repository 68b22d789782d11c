"""Readers from a TOML file, which may change while it is in use.

A table ``[defaults]`` holds what readers share, ``[[readers]]`` one reader each: ``id``, ``site_enu_m`` (east, north
and, where heights matter, up) or ``site`` (latitude_deg, longitude_deg, height_m), and where they differ from the
defaults ``max_range_m``, ``sigma_m``, ``period_s`` and ``p_detect``.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import Geodetic, SensorInfo
from trackmesh.protocol.messages.base import Finite, Id, Positive


class _Shared(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    max_range_m: Positive = 100.0
    sigma_m: Positive | None = None
    period_s: Positive = 1.0
    p_detect: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class _Reader(_Shared):
    id: Id
    site_enu_m: Annotated[list[Finite], Field(min_length=2, max_length=3)] | None = None
    site: Geodetic | None = None

    @model_validator(mode="after")
    def _has_one_site(self) -> Self:
        if (self.site is None) == (self.site_enu_m is None):
            raise ValueError("give either site_enu_m or site")
        return self

    def info(self) -> SensorInfo:
        return SensorInfo(
            sensor_id=self.id,
            kind="ranging",
            site=self.site,
            site_enu_m=None if self.site_enu_m is None else [*self.site_enu_m, 0.0][:3],
            period_s=self.period_s,
            p_detect=self.p_detect,
            max_range_m=self.max_range_m,
            sigma={} if self.sigma_m is None else {"range_m": self.sigma_m},
        )


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    defaults: dict[str, Any] = {}
    readers: list[dict[str, Any]]


def read_readers(path: Path) -> list[SensorInfo]:
    """The readers of a file, in its order.

    Raises:
        TrackmeshError: the file cannot be read or is wrong; the sentence says where and why.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrackmeshError(f"Cannot read {path}: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TrackmeshError(f"{path} is no TOML: {error}.") from None
    try:
        file = _File.model_validate(content)
        defaults = _Shared.model_validate(file.defaults).model_dump(exclude_unset=True)
        found = [_Reader.model_validate(defaults | one).info() for one in file.readers]
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(str(step) for step in first["loc"]) or "a reader"
        what = first["msg"].removeprefix("Value error, ")
        raise TrackmeshError(f"{path} is not valid: {where}: {what}.") from None
    names = [info.sensor_id for info in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise TrackmeshError(f"{path} names the reader {twice[0]!r} more than once.")
    return found


class ReaderFile:
    """A file of readers that may change while it is in use.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen: tuple[int, int] | None = None
        self._names: set[str] = set()

    def changes(self) -> tuple[list[SensorInfo], list[str]] | None:
        """All readers of the file, and the names that are in it no longer; None if it did not change since last time.

        Raises:
            TrackmeshError: the file cannot be read or is wrong; it is not tried again before it changes.
        """
        try:
            status = self.path.stat()
        except OSError as error:
            if self._seen == (-1, -1):
                return None
            self._seen = (-1, -1)
            raise TrackmeshError(f"Cannot read {self.path}: {error.strerror}.") from None
        stamp = (status.st_mtime_ns, status.st_size)
        if stamp == self._seen:
            return None
        self._seen = stamp
        infos = read_readers(self.path)
        names = {info.sensor_id for info in infos}
        gone, self._names = sorted(self._names - names), names
        return infos, gone
