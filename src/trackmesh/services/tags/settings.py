"""What a tag service can be told."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from trackmesh.protocol.messages import Geodetic
from trackmesh.protocol.messages.base import Finite, Id, NonNegative, Positive
from trackmesh.services.runtime import ServiceSettings
from trackmesh.services.tags.life import EVERYWHERE, Manners
from trackmesh.services.tags.records import CORRECTED, Describe, MotionName, UpdateName
from trackmesh.services.tags.rssi import PathLossPrior

_WALK_S = 1.0 / 3.0
_WHITE_S = 0.25
_NEVER = 1e9

Place = Annotated[list[Finite], Field(min_length=2, max_length=2)]


class TagEngineSettings(BaseModel):
    """Constants of the tag engine; the defaults suit people and vehicles in a hall, by ranges of a metre or two."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    motion: MotionName = Field("tvimm", description="tvimm: random walk, constant velocity and Singer; or singer alone")
    update: UpdateName = Field("ut", description="ut: 2-D unscented; ekf; ukf-printed only to compare, with singer")
    speed_mps: Positive = Field(3.0, description="speed of a tag, one sigma per axis")
    acceleration_mps2: Positive = Field(2.0, description="its acceleration, one sigma per axis")
    alpha: Positive = Field(0.5, description="1/s: how fast an acceleration is forgotten")
    sojourn_s: Positive = Field(5.0, description="tvimm: mean time in each model")
    adapt_acceleration: bool = Field(False, description="learn each tag's acceleration while it is tracked")
    range_sigma_m: Positive = Field(1.0, description="noise of a range, where neither batch nor reader tells it")
    range_bias_sd_m: NonNegative = Field(0.0, description="common bias to be expected of a tag's ranges; 0: none")
    range_scale_sd: NonNegative = Field(0.0, description="likewise, as a share of the distance; 0: none")
    doubt_sigma: Annotated[float, Field(gt=0)] | None = Field(
        2.0, description="a range longer by more than so many sigmas counts less: something stood in the way; none: off"
    )
    doubts_to_restart: Annotated[int, Field(ge=2)] = Field(8, description="doubted ranges in a row that start anew")
    start_window_s: Positive = Field(2.0, description="ranges of this time serve to find a tag's first place")
    start_wait_s: NonNegative = Field(1.0, description="with fewer than three readers a tag waits so long, unlocated")
    lost_s: Positive = Field(30.0, description="silence after which a tag is lost")
    forget_s: Positive = Field(600.0, description="silence after which a tag is gone")
    heard_s: Positive = Field(5.0, description="a reader counts as used for this time")
    reorder_s: NonNegative = Field(0.1, description="ranges wait so long for earlier ones of other networks")
    clock_back_s: Positive = Field(60.0, description="time that jumps back by more is a clock that was set: start anew")
    area_enu_m: Annotated[list[Finite], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north of where tags can be; decides between a place and its mirror image"
    )
    tag_height_m: Finite | None = Field(None, description="height of the tags; none: ranges are along the plane")
    references: dict[Id, Place] = Field(
        {}, description="tags whose place [east, north] is known: they teach the RSSI law"
    )
    rssi_1m_dbm: Finite = Field(-45.0, description="RSSI at one metre, as far as is known")
    rssi_exponent: Positive = Field(2.5, description="exponent of its loss, as far as is known")
    rssi_noise_db: Positive = Field(3.0, description="noise of a reading")
    max_tags: Annotated[int, Field(ge=1)] = Field(100_000, description="more are left out and counted")
    frame_period_s: NonNegative = Field(0.2, description="least time between frames; 0: one after every batch")
    idle_frame_s: Positive = Field(1.0, description="time between frames while no data comes")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.update == "ukf-printed" and (self.motion != "singer" or self.range_bias_sd_m or self.range_scale_sd):
            raise ValueError("ukf-printed needs motion = singer, and neither bias nor scale of ranges")
        if self.area_enu_m and not (
            self.area_enu_m[0] < self.area_enu_m[2] and self.area_enu_m[1] < self.area_enu_m[3]
        ):
            raise ValueError("area_enu_m must be west, south, east, north")
        if self.forget_s < self.lost_s:
            raise ValueError("forget_s must not be below lost_s")
        return self

    def description(self) -> Describe:
        """The filter of a tag."""
        return Describe(
            motion=self.motion,
            update=self.update,
            alpha=self.alpha,
            acceleration_mps2=self.acceleration_mps2,
            speed_mps=self.speed_mps,
            walk_m2ps=_WALK_S * self.speed_mps**2,
            velocity_m2ps3=_WHITE_S * self.acceleration_mps2**2,
            sojourn_s=self.sojourn_s,
            bias_sd_m=self.range_bias_sd_m,
            scale_sd=self.range_scale_sd,
            doubt_long=self.doubt_sigma or _NEVER,
            doubt_short=2.0 * self.doubt_sigma if self.doubt_sigma else _NEVER,
            adapt=CORRECTED if self.adapt_acceleration else 0,
            acceleration_least_mps2=0.1 * self.acceleration_mps2,
            acceleration_most_mps2=10.0 * self.acceleration_mps2,
        )

    def manners(self) -> Manners:
        """How tags live."""
        area = EVERYWHERE if self.area_enu_m is None else np.array(self.area_enu_m)
        walk_mps = 0.5 * self.speed_mps
        return Manners(self.start_window_s, self.start_wait_s, self.lost_s, self.doubts_to_restart, walk_mps, area)

    def path_loss(self) -> PathLossPrior:
        """What is expected of signal strengths."""
        return PathLossPrior(self.rssi_1m_dbm, self.rssi_exponent, self.rssi_noise_db)


class TagSettings(ServiceSettings):
    """Settings of the tag service."""

    engine: TagEngineSettings = TagEngineSettings()
    origin: Geodetic | None = Field(None, description="origin of the plane; default: the first geodetic reader")
    readers: Path | None = Field(None, description="TOML file of readers, read again whenever it changes")
    clock: Literal["wall", "data"] = Field(
        "wall", description="wall: ranges must be of now; data: time is that of the ranges (replayed recordings)"
    )
    max_age_s: Positive = Field(60.0, description="wall clock: ranges older than this are refused")
    max_ahead_s: Positive = Field(2.0, description="wall clock: ranges further in the future are refused")
    max_batch_bytes: Annotated[int, Field(ge=1024)] = Field(4 * 2**20, description="larger batches are refused")
    max_readers: Annotated[int, Field(ge=1)] = Field(4096, description="more readers are refused")
    tick_s: Positive = Field(0.25, description="how often time advances without data")
    black_box: Path | None = Field(None, description="file that records the engine's inputs")
