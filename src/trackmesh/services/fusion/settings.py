"""What a fusion unit can be told."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from trackmesh.protocol.messages import Geodetic
from trackmesh.protocol.messages.base import ID_PATTERN, ID_RE, NonNegative, Positive
from trackmesh.services.estimation.alpha_beta_tracks import AlphaBetaTracks
from trackmesh.services.estimation.bank import Branch, make_models
from trackmesh.services.estimation.filters import (
    FilterName,
    generic_models,
    manoeuvre_models,
    velocity_models,
    with_more_noise,
)
from trackmesh.services.estimation.heights import HeightTracks
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.estimation.pairs import PairRules
from trackmesh.services.estimation.uncertain import NoiseModel
from trackmesh.services.fusion.association import SequentialTest
from trackmesh.services.fusion.biases import RegistrationRules
from trackmesh.services.fusion.inputs import InputRules
from trackmesh.services.fusion.layer import TrackFilters
from trackmesh.services.fusion.pair_tests import PairTest, TestName, make_test
from trackmesh.services.fusion.partition.settings import PartitionSettings
from trackmesh.services.runtime import ServiceSettings, Texts


class EngineSettings(BaseModel):
    """Constants of the fusion engine; the defaults suit air surveillance by rotating radars."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    filter: FilterName = Field("tvimm", description="the filter of the system tracks")
    local_filter: FilterName = Field(
        "imm", description="the filter of local tracks, which serve association only: a cheap one does as well"
    )
    q_m2ps3: Annotated[list[Positive], Field(min_length=1, max_length=4)] = Field(
        [1.0, 50.0, 500.0], description="acceleration noise density of each constant-velocity model"
    )
    sojourn_s: Annotated[list[Positive], Field(min_length=1, max_length=4)] = Field(
        [50.0, 15.0, 15.0], description="mean time a target stays in each model"
    )
    tpm_prior_count: Positive = Field(20.0, description="weight of the sojourn times against observed transitions")
    tpm_memory_s: Positive = Field(80.0, description="how long observed transitions are remembered")
    tpm_reference_s: Positive = Field(4.0, description="interval whose expected transition counts as one")
    turn_rate_max_degps: Positive = Field(6.0, description="tvimm: fastest turn expected; rather too high than too low")
    acceleration_max_mps2: Positive = Field(10.0, description="tvimm: strongest acceleration expected")
    manoeuvre_s: Positive = Field(18.0, description="tvimm: typical length of a manoeuvre")
    quiet_s: Positive = Field(45.0, description="tvimm: typical time between manoeuvres")
    q_quiet: Positive = Field(0.3, description="tvimm: acceleration noise of quiet flight, m/s^1.5")
    alpha_beta_acceleration_mps2: Positive = Field(5.0, description="alpha-beta: random acceleration, one sigma")
    noise_model: NoiseModel = Field(
        "gaussian", description="uncertain: the interference that a sensor declares counts as an error of its plots"
    )
    process_interference: NonNegative = Field(
        0.0, description="uncertain: acceleration noise density of interference with the motion, m^2/s^3"
    )
    lag: Annotated[int, Field(ge=0, le=4)] = Field(
        0, description="publish, beside the picture, states refined by this many later plots"
    )
    sigma_velocity_mps: Positive = Field(150.0, description="velocity of a new track, one sigma per axis")
    height_q_m2ps3: Positive = Field(1.0, description="acceleration noise density of climb and descent")
    sigma_climb_mps: Positive = Field(20.0, description="climb rate of a new track, one sigma")
    gate: Positive = Field(14.0, description="largest squared Mahalanobis distance of a plot to a track's model")
    confirm_score: Positive = Field(12.0, description="log-likelihood ratio that confirms a track")
    confirm_hits: Annotated[int, Field(ge=1)] = Field(3, description="plots a track needs to be confirmed")
    score_cap: Positive = 30.0
    drop_score: Annotated[float, Field(lt=0)] = -2.0
    drop_fall: Positive = 6.0
    end_fall: Positive = Field(
        12.0, description="a confirmed track ends when its score is so far below its best: it lives on clutter"
    )
    max_misses: Annotated[int, Field(ge=1)] = 3
    coast_s: Positive = Field(15.0, description="a confirmed track ends after this time without a plot")
    stitch_s: NonNegative = Field(
        40.0, description="a new track may take over the number of one whose last plot is not older than this; 0: never"
    )
    stitch_q_m2ps3: Positive = Field(200.0, description="acceleration noise over the gap that is bridged so")
    local_coast_periods: Positive = 4.0
    ring_system: Annotated[int, Field(ge=2, le=512)] = Field(
        32, description="plots a system track keeps, of which the younger half can always be replayed"
    )
    ring_local: Annotated[int, Field(ge=2, le=512)] = 16
    lateness_s: NonNegative = Field(
        0.0, description="plots usually come no later than this: a sector without a plot is judged so much later"
    )
    clutter_areas: bool = Field(True, description="estimate false plots area by area, not only over all")
    max_lateness_s: Positive = Field(10.0, description="plots older than this are dropped and counted")
    plot_assignment: Literal["nearest", "joint"] = Field(
        "nearest", description="joint: system tracks that are close take weighted means of plots, for formations"
    )
    cycle_s: Positive = Field(2.0, description="association cycle")
    association: TestName = Field("seqllr", description="the test of whether local tracks are of one target")
    association_alpha: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        0.001, description="gnn, paper-sequential: share of true pairs that chi-square rejects"
    )
    noise_tails: Literal["student", "gaussian"] = Field(
        "student", description="seqllr: how differences of tracks of one target are distributed"
    )
    pair_speed_mps: Positive = Field(250.0, description="spread of velocities expected of unrelated tracks, per axis")
    pair_radius_m: Positive = Field(10_000.0, description="radius in which the density of tracks is counted")
    registration: bool = Field(True, description="estimate the sensors' biases, and correct plots once they are known")
    bias_range_m: NonNegative = Field(300.0, description="range bias expected of a radar, one sigma; 0: none")
    bias_azimuth_deg: NonNegative = Field(0.6, description="azimuth bias expected of a radar, one sigma")
    bias_position_m: NonNegative = Field(100.0, description="bias expected of a position sensor, one sigma per axis")
    bias_time_s: NonNegative = Field(
        0.0, description="time offset expected of a sensor's clock, one sigma; 0: clocks are right"
    )
    right_clocks: list[str] = Field(
        [], description="sensors whose clocks are right; without one, of time offsets only differences can be known"
    )
    one_mast: bool = Field(
        False, description="the sensors stand together: correct also where only their difference can be known"
    )
    lock_m: Positive = Field(100.0, description="plots are corrected once the shift at 50 km is known so well")
    restart_shift_m: Positive = Field(
        500.0, description="a first correction larger than this at 50 km makes the picture anew from local tracks"
    )
    input_q_m2ps3: Positive = Field(
        100.0, description="acceleration noise under which the tracks of other units are predicted"
    )
    input_error_m: NonNegative = Field(
        0.0, description="error of other units' positions that their covariances do not know, one sigma per axis"
    )
    input_reference: bool = Field(
        False, description="other units' positions are right but for input_error_m: learn the sensors' biases from them"
    )
    frame_period_s: NonNegative = Field(0.0, description="least time between frames; 0: one after every batch")
    idle_frame_s: Positive = Field(1.0, description="time between frames while no data comes")
    publish_tentative: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.q_m2ps3) != len(self.sojourn_s):
            raise ValueError("q_m2ps3 and sojourn_s must be equally long")
        if self.lag and self.filter in ("alpha-beta", "tvimm-paper"):
            raise ValueError(f"the filter {self.filter} keeps no lag: choose lag = 0 or another filter")
        if self.plot_assignment == "joint" and self.filter == "alpha-beta":
            raise ValueError("the filter alpha-beta takes plots one to one: choose plot_assignment = nearest")
        if self.process_interference:
            self._check_process_interference()
        return self

    def _check_process_interference(self) -> None:
        if self.noise_model != "uncertain":
            raise ValueError("process_interference needs the noise model uncertain")
        if "alpha-beta" in (self.filter, self.local_filter):
            raise ValueError("the filter alpha-beta has no process_interference: use alpha_beta_acceleration_mps2")

    def system_tracks(self, rows: int) -> TrackFilters:
        """Filters for the system tracks."""
        return self._tracks(self.filter, rows, self.ring_system, self.lag, self.plot_assignment == "joint")

    def height_tracks(self) -> HeightTracks:
        """The filters of the system tracks' heights."""
        return HeightTracks(self.height_q_m2ps3 + self.process_interference, self.sigma_climb_mps)

    def local_tracks(self, rows: int) -> TrackFilters:
        """Filters for the local tracks of one sensor."""
        return self._tracks(self.local_filter, rows, self.ring_local, 0)

    def pair_test(self) -> PairTest:
        """A new test between the local tracks of two sensors."""
        return make_test(self.association, self._pair_rules(), self.association_alpha)

    def input_rules(self) -> InputRules:
        """What to expect of other units."""
        return InputRules(
            self.coast_s, self.stitch_s, self.input_q_m2ps3, self.input_error_m, self.input_reference, self._input_test
        )

    def _input_test(self) -> PairTest:
        # What both units show may be swapped in either of them: evidence of before must fade sooner.
        return SequentialTest(self._pair_rules()._replace(memory_s=15.0, fit_memory_s=4.0))

    def _pair_rules(self) -> PairRules:
        rules = PairRules(speed_mps=self.pair_speed_mps, radius_m=self.pair_radius_m)
        return rules._replace(nu=np.inf) if self.noise_tails == "gaussian" else rules

    def registration_rules(self) -> RegistrationRules:
        """What to expect of biases."""
        return RegistrationRules(
            prior_range_m=self.bias_range_m,
            prior_azimuth_rad=float(np.deg2rad(self.bias_azimuth_deg)),
            prior_position_m=self.bias_position_m,
            prior_time_offset_s=self.bias_time_s,
            lock_difference=self.one_mast,
            lock_m=self.lock_m,
        )

    def model_names(self) -> list[str]:
        """Names of the models in a frame."""
        if self.filter == "alpha-beta":
            return ["alpha-beta"]
        return [model.name for branch in self._branches(self.filter) for model in branch.models]

    def manoeuvre_models(self) -> int:
        """How many of the models, from the first, are of the branch whose weight says that manoeuvres are modelled."""
        return len(self._branches(self.filter)[0].models) if self.filter == "tvimm" else 0

    def _tracks(self, name: str, rows: int, ring: int, lags: int, joint: bool = False) -> TrackFilters:
        if name == "alpha-beta":
            return AlphaBetaTracks(rows, self.sigma_velocity_mps, self.alpha_beta_acceleration_mps2)
        models = make_models(
            self._branches(name),
            memory_s=self.tpm_memory_s,
            reference_s=self.tpm_reference_s,
            printed=name == "tvimm-paper",
            lags=lags,
        )
        return ImmTracks(models, rows, ring, self.sigma_velocity_mps, joint)

    def _branches(self, name: str) -> tuple[Branch, ...]:
        return tuple(with_more_noise(branch, self.process_interference) for branch in self._quiet_branches(name))

    def _quiet_branches(self, name: str) -> tuple[Branch, ...]:
        if name == "tvimm":
            words = (self.acceleration_max_mps2, self.manoeuvre_s, self.quiet_s, self.q_quiet)
            return (manoeuvre_models(np.deg2rad(self.turn_rate_max_degps), *words), generic_models(*words))
        prior = self.tpm_prior_count if name == "tvimm-dirichlet" else np.inf
        return (velocity_models(self.q_m2ps3, self.sojourn_s, prior),)


_RING_OF_AREA = 16


def _ids(names: list[str]) -> list[str]:
    for name in names:
        if not ID_RE.fullmatch(name):
            raise ValueError(f"{name!r} is no name: it must match {ID_PATTERN}")
    if len(set(names)) < len(names):
        raise ValueError("a name is given twice")
    return names


Ids = Annotated[Texts, AfterValidator(_ids)]
"""Names, in the environment and in flags separated by commas."""


class FusionSettings(ServiceSettings):
    """Settings of the fusion service."""

    unit_number: Annotated[int, Field(ge=0, le=4095)] = Field(
        0, description="number of this unit, unique in the realm: the high bits of its track ids"
    )
    origin: Geodetic | None = Field(None, description="origin of the system plane; default: the first geodetic site")
    sensors: Ids = Field([], description="take the plots of these sensors only; default: all of the realm")
    inputs: Ids = Field([], description="other units, or trackers, whose tracks are taken as well")
    partition: PartitionSettings | None = Field(None, description="the area of this unit, where several share a realm")
    engine: EngineSettings = EngineSettings()
    clock: Literal["wall", "data"] = Field(
        "wall", description="wall: plots must be of now; data: time is that of the plots (replayed recordings)"
    )
    max_age_s: Positive = Field(60.0, description="wall clock: plots older than this are refused")
    max_ahead_s: Positive = Field(2.0, description="wall clock: plots further in the future are refused")
    max_batch_bytes: Annotated[int, Field(ge=1024)] = Field(4 * 2**20, description="larger plot batches are refused")
    max_sensors: Annotated[int, Field(ge=1, le=4096)] = Field(128, description="more sensors are refused")
    max_batches_per_s: NonNegative = Field(
        0.0, description="wall clock: of a sensor, more are refused; 0: four times what it declares, at least 50"
    )
    max_plots_per_s: Positive = Field(10_000.0, description="wall clock: of a sensor, more are refused")
    clock_limit_s: Positive = Field(0.25, description="a sensor's clock that is further off is told")
    clock_drift_limit_ppm: Positive = Field(100.0, description="a sensor's clock that drifts faster is told")
    tick_s: Positive = Field(0.25, description="how often time advances without data")
    black_box: Path | None = Field(None, description="file that records the engine's inputs")
    state_file: Path | None = Field(
        None, description="file that keeps the tracks over restarts; read at the start, written every state_every_s"
    )
    state_every_s: Positive = 10.0
    registration_file: Path | None = Field(
        None, description="file that keeps the sensors' biases over restarts; read at the start, written every minute"
    )

    @model_validator(mode="after")
    def _can_be_partitioned(self) -> Self:
        if self.partition is None:
            return self
        if self.inputs:
            raise ValueError("a unit with an area takes no tracks of other units as inputs")
        if self.black_box is not None:
            raise ValueError("a unit with an area keeps no black box: what other units tell it is not recorded yet")
        if self.engine.filter == "alpha-beta":
            raise ValueError("the filter alpha-beta remembers no plots: a unit with an area needs another")
        if self.engine.ring_system < _RING_OF_AREA:
            raise ValueError(f"engine.ring_system must be {_RING_OF_AREA} at least where a unit has an area")
        self.partition.place(self.origin)
        return self

    def band_width_m(self) -> float:
        """How far beyond its area this unit takes plots."""
        assert self.partition is not None
        engine = self.engine
        return self.partition.width(engine.cycle_s, engine.bias_range_m, float(np.deg2rad(engine.bias_azimuth_deg)))

    @field_validator("inputs")
    @classmethod
    def _not_itself(cls, inputs: list[str], info: ValidationInfo) -> list[str]:
        if info.data.get("unit_id") in inputs:
            raise ValueError("a unit cannot take its own tracks")
        return inputs
