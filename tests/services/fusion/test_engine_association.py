"""The engine with each of the tests between local tracks."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from tests.services.fusion.makers import EAST, FAR_APART, NORTH, drive, engine, in_time_order, live, scans

from trackmesh.services.fusion.association import SequentialTest
from trackmesh.services.fusion.pair_tests import NearestTest, SumTest, TestName
from trackmesh.services.fusion.settings import EngineSettings

NAMES: tuple[TestName, ...] = ("seqllr", "paper-sequential", "gnn")


@pytest.mark.parametrize("name", NAMES)
def test_every_test_declares_the_targets_that_two_radars_see(name: TestName) -> None:
    tracker = engine(NORTH, EAST, association=name)
    batches = in_time_order(scans(NORTH, FAR_APART, 40.0), scans(EAST, FAR_APART, 40.0, offset_s=0.7, seed=2))
    frame = drive(tracker, batches)[-1]
    assert len(live(frame)) == len(FAR_APART.start)
    told = tracker.registration()
    assert told is not None
    # Every declared pair teaches the registration something.
    assert all(sensor.pairs >= 3 * len(FAR_APART.start) for sensor in told.sensors)


def test_the_settings_choose_the_test() -> None:
    kinds = [type(EngineSettings(association=name).pair_test()) for name in NAMES]
    assert kinds == [SequentialTest, SumTest, NearestTest]
    assert type(EngineSettings().pair_test()) is SequentialTest
    # A test each: pairs of sensors share nothing.
    settings = EngineSettings()
    assert settings.pair_test() is not settings.pair_test()


def test_the_settings_choose_the_tails() -> None:
    student, gaussian = (EngineSettings(noise_tails=tails).pair_test() for tails in ("student", "gaussian"))
    assert isinstance(student, SequentialTest)
    assert isinstance(gaussian, SequentialTest)
    assert student.rules.nu == 8.0
    assert gaussian.rules == student.rules._replace(nu=np.inf)
    other = EngineSettings(pair_speed_mps=10.0, pair_radius_m=200.0).pair_test()
    assert isinstance(other, SequentialTest)
    assert (other.rules.speed_mps, other.rules.radius_m) == (10.0, 200.0)


@pytest.mark.parametrize("wrong", [{"association": "nearest"}, {"association_alpha": 0.0}, {"noise_tails": "cauchy"}])
def test_what_is_no_choice_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        EngineSettings.model_validate(wrong)
