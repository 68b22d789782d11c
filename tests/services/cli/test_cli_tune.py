"""The command tune, as a person uses it: on a short recording, by few evaluations."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.services.cli.conftest import ROOT, Run

from trackmesh.protocol.files import RecordWriter, UnitRecord, read_records
from trackmesh.services.fusion import tuning
from trackmesh.services.fusion.settings import EngineSettings, FusionSettings

WORDS = {"turn_rate_max_degps", "acceleration_max_mps2", "manoeuvre_s", "quiet_s", "q_quiet"}
CONFIG = """
unit_id = "west"
connect = ["tcp/10.0.0.1:7447"]

[origin]
latitude_deg = 48.35
longitude_deg = 11.78
height_m = 450.0

[engine]
filter = "imm"
q_m2ps3 = [40.0, 900.0]
sojourn_s = [20.0, 20.0]
gate = 12.0
"""


@pytest.fixture(scope="module")
def short(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with half a minute of two radars, and a file of settings."""
    folder = tmp_path_factory.mktemp("short")
    result = run("sim", "record", folder / "plots.jsonl", folder / "truth.jsonl", "--seconds", 30)
    assert result.exit_code == 0, result.output
    (folder / "west.toml").write_text(CONFIG)
    return folder


def scores(sentence: str) -> list[float]:
    """The numbers in "from .. to .." of the sentence."""
    return [float(number) for pair in re.findall(r"from (-?[\d.]+) to (-?[\d.]+)", sentence) for number in pair]


def tuned(short: Path, *more: object) -> tuple[object, ...]:
    return ("tune", short / "plots.jsonl", short / "truth.jsonl", "--warmup", 10, *more)


# --- with the truth


def test_what_is_found_is_written_with_everything_else(run: Run, good: Run, short: Path, tmp_path: Path) -> None:
    file = tmp_path / "tuned.toml"
    config = ("--config", short / "west.toml")
    result = run(*tuned(short, *config, "--out", file, "--evaluations", 8))
    assert result.exit_code == 0, result.output
    before, after = tomllib.loads(CONFIG), tomllib.loads(file.read_text())
    sought = {"q_m2ps3", "sojourn_s"}
    assert {k: v for k, v in after.items() if k != "engine"} == {k: v for k, v in before.items() if k != "engine"}
    assert {k: v for k, v in after["engine"].items() if k not in sought} == {"filter": "imm", "gate": 12.0}
    assert after["engine"]["q_m2ps3"] == sorted(after["engine"]["q_m2ps3"]) != before["engine"]["q_m2ps3"]
    # The same loader, and both commands that use it.
    given, found = FusionSettings.load(short / "west.toml"), FusionSettings.load(file)
    changed = given.engine.model_copy(update={name: getattr(found.engine, name) for name in sought})
    assert found == given.model_copy(update={"engine": changed})
    good("track", short / "plots.jsonl", "--config", file, "--out", tmp_path / "tracks.jsonl")
    # What people are told.
    first = result.stderr.splitlines()[0]
    assert first.startswith("after 8 evaluations: mean GOSPA from ") and first.endswith(f"; settings in {file}")
    head_before, head_after, _, _ = scores(first)
    assert head_after < head_before
    assert "q_m2ps3" in result.stdout and "40, 900" in result.stdout


def test_equal_seeds_write_equal_files_and_others_do_not(run: Run, short: Path, tmp_path: Path) -> None:
    texts = []
    for name, seed in (("a.toml", 3), ("b.toml", 3), ("c.toml", 4)):
        assert run(*tuned(short, "--out", tmp_path / name, "--evaluations", 4, "--seed", seed)).exit_code == 0
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1] != texts[2]


def test_one_evaluation_keeps_the_settings_given(run: Run, short: Path) -> None:
    result = run(*tuned(short, "--evaluations", 1))
    assert result.exit_code == 0
    assert "after 1 evaluation: nothing is better than the settings given, mean GOSPA " in result.stderr
    engine = tomllib.loads(result.stdout)["engine"]
    assert EngineSettings.model_validate(engine) == EngineSettings()
    assert engine.keys() == {"filter", *WORDS}


def test_the_method_for_truth_of_some_targets(run: Run, short: Path) -> None:
    result = run(*tuned(short, "--nearest", "--c", 500, "--evaluations", 3))
    assert result.exit_code == 0 and "mean GOSPA" in result.stderr
    assert tomllib.loads(result.stdout)["engine"].keys() == {"filter", *WORDS}


# --- without


def test_without_truth_plots_are_predicted_better(run: Run, short: Path, tmp_path: Path) -> None:
    file = tmp_path / "wild.toml"
    file.write_text('[engine]\nfilter = "imm"\nq_m2ps3 = [900.0, 9000.0]\nsojourn_s = [20.0, 20.0]\n')
    result = run("tune", short / "plots.jsonl", "--config", file, "--evaluations", 6)
    assert result.exit_code == 0, result.output
    first = result.stderr.splitlines()[0]
    assert first.startswith("after 6 evaluations: log-likelihood of a plot from ")
    head_before, head_after, tail_before, tail_after = scores(first)
    assert head_after > head_before and tail_after > tail_before
    assert tomllib.loads(result.stdout)["engine"]["q_m2ps3"][0] < 900.0


def test_a_filter_is_chosen_on_the_command_line(run: Run, short: Path) -> None:
    config = ("--config", short / "west.toml", "--filter", "tvimm")
    result = run("tune", short / "plots.jsonl", *config, "--evaluations", 2)
    assert result.exit_code == 0, result.output
    engine = tomllib.loads(result.stdout)["engine"]
    assert engine.keys() == {"filter", "q_m2ps3", "sojourn_s", "gate", *WORDS}
    assert engine["filter"] == "tvimm" and engine["q_m2ps3"] == [40.0, 900.0]


def test_a_black_box_is_tuned_from_its_own_settings(run: Run, short: Path, tmp_path: Path) -> None:
    settings = {"filter": "imm", "q_m2ps3": [70.0], "sojourn_s": [30.0]}
    unit = UnitRecord(unit_id="a", unit_number=1, boot_id="b", first_track_number=1, settings=settings)
    with RecordWriter(tmp_path / "box.jsonl") as box:
        for record in (unit, *read_records(short / "plots.jsonl")):
            box.write(record)
    result = run("tune", tmp_path / "box.jsonl", "--evaluations", 1)
    assert tomllib.loads(result.stdout)["engine"] == settings
    chosen = run("tune", tmp_path / "box.jsonl", "--evaluations", 1, "--config", short / "west.toml")
    assert tomllib.loads(chosen.stdout)["engine"]["q_m2ps3"] == [40.0, 900.0]


# --- what people are told while it runs, and after


def fake(
    monkeypatch: pytest.MonkeyPatch, score: Callable[[EngineSettings, bool], float], stop_at: int | None = None
) -> list[EngineSettings]:
    """Instead of tracking: ``score(settings, held_out)``; Ctrl-C at the evaluation of this number."""
    tried: list[EngineSettings] = []

    def evaluate(_records: object, settings: EngineSettings, _objective: object, *, begin: int, **_: object) -> float:
        tried.append(settings)
        if len(tried) == stop_at:
            raise KeyboardInterrupt
        return score(settings, begin > 0)

    monkeypatch.setattr(tuning, "evaluate", evaluate)
    return tried


def test_a_recording_that_was_learnt_by_heart_is_told(monkeypatch: pytest.MonkeyPatch, run: Run, short: Path) -> None:
    fake(monkeypatch, lambda settings, held_out: -settings.quiet_s if held_out else settings.quiet_s)
    result = run(*tuned(short, "--evaluations", 10))
    assert result.exit_code == 0
    sentence, warning = result.stderr.splitlines()
    assert "held out" in sentence
    assert warning.startswith("Beware: on the last 30 %, held out, the settings found are worse than those given")
    fake(monkeypatch, lambda settings, held_out: settings.quiet_s)
    assert "Beware" not in run(*tuned(short, "--evaluations", 10)).stderr


def test_a_bound_that_was_reached_is_told(monkeypatch: pytest.MonkeyPatch, run: Run, short: Path) -> None:
    fake(monkeypatch, lambda settings, _: settings.q_quiet)
    result = run(*tuned(short, "--evaluations", 60))
    assert "Beware: q_quiet went to the bound of the search" in result.stderr
    assert tomllib.loads(result.stdout)["engine"]["q_quiet"] == 0.005


def test_ctrl_c_keeps_the_best_so_far(monkeypatch: pytest.MonkeyPatch, run: Run, short: Path, tmp_path: Path) -> None:
    tried = fake(monkeypatch, lambda settings, _: settings.quiet_s, stop_at=7)
    result = run(*tuned(short, "--out", tmp_path / "x.toml", "--evaluations", 20))
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith("stopped after 6 evaluations: mean GOSPA from 45.000 to ")
    assert "the last 30 % not looked at" in result.stderr
    best = FusionSettings.load(tmp_path / "x.toml").engine
    assert best.quiet_s == min(settings.quiet_s for settings in tried[:6]) < 45.0


def test_ctrl_c_before_anything_is_known_writes_nothing(
    monkeypatch: pytest.MonkeyPatch, run: Run, short: Path, tmp_path: Path
) -> None:
    fake(monkeypatch, lambda *_: 0.0, stop_at=1)
    result = run(*tuned(short, "--out", tmp_path / "x.toml"))
    assert result.exit_code == 1
    assert result.stderr == "trackmesh: Stopped before the settings given were evaluated, so nothing was found.\n"
    assert not (tmp_path / "x.toml").exists()


# --- mistakes

FILES = {
    "empty.jsonl": "",
    "tick.jsonl": '{"type":"tick","t_ns":1}\n',
    "early.jsonl": '{"type":"truth","scenario_id":"x","t_ns":1,"id":[1],"state":[[0,0,0,0]]}\n',
    "unknown.toml": "[engine]\nspeed = 3\n",
    "stranger.jsonl": '{"type":"plots","schema_version":1,"sensor_id":"x","boot_id":"b","seq":0,"t_ns":[1],'
    '"columns":["east_m","north_m"],"values":[[0,0]],"variances":null,"labels":null,"scan":null}\n',
}

MISTAKES = [
    ("none.jsonl", "Cannot read none.jsonl: No such file or directory."),
    ("empty.jsonl", "empty.jsonl holds no plots, so there is nothing to tune on."),
    ("tick.jsonl", "tick.jsonl holds no plots, so there is nothing to tune on."),
    ("truth.jsonl", "truth.jsonl holds no plots, so there is nothing to tune on."),
    ("stranger.jsonl", "Nothing of stranger.jsonl is scored by the settings given"),
    ("plots.jsonl none.jsonl", "Cannot read none.jsonl: No such file or directory."),
    ("plots.jsonl empty.jsonl", "The truth holds no frame"),
    ("plots.jsonl plots.jsonl", "plots.jsonl, line 1: a line of type truth is expected, not origin."),
    ("plots.jsonl early.jsonl", "early.jsonl does not overlap plots.jsonl in time, so there is nothing to tune on."),
    ("plots.jsonl truth.jsonl --warmup 100", "Nothing of plots.jsonl is scored by the settings given"),
    ("plots.jsonl --filter kalman", "The setting engine.filter is wrong: Input should be 'tvimm'"),
    ("plots.jsonl --config none.toml", "Cannot read none.toml"),
    ("plots.jsonl --config unknown.toml", "Unknown setting engine.speed in unknown.toml."),
    ("plots.jsonl --out none/x.toml", "none/x.toml: No such file or directory."),
]

USAGE = [
    "",
    "plots.jsonl --evaluations 0",
    "plots.jsonl --seed=-1",
    "plots.jsonl truth.jsonl --c 0",
    "plots.jsonl truth.jsonl x.toml",
]


@pytest.fixture
def folder(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    for name in ("plots.jsonl", "truth.jsonl"):
        (tmp_path / name).symlink_to(short / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("line", "sentence"), MISTAKES)
def test_what_is_wrong_is_one_sentence(run: Run, folder: Path, line: str, sentence: str) -> None:
    result = run("tune", *line.split(), *([] if "--out" in line else ["--out", "x.toml"]))
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    (told,) = result.stderr.splitlines()
    assert sentence in told and result.stdout == ""
    assert not (folder / "x.toml").exists()


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("line", USAGE)
def test_a_wrong_use_is_exit_code_2(run: Run, line: str) -> None:
    result = run("tune", *line.split())
    assert result.exit_code == 2 and "Usage: " in result.output and "Traceback" not in result.output


def test_the_harbour_example_can_be_tuned(run: Run, short: Path) -> None:
    config = ("--config", ROOT / "examples" / "harbour.toml")
    result = run("tune", short / "plots.jsonl", *config, "--evaluations", 1)
    assert result.exit_code == 0, result.output
    assert tomllib.loads(result.stdout) == tomllib.loads((ROOT / "examples" / "harbour.toml").read_text())
