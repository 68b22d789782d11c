"""Commands that are one process of a deployment: router, fusion, emi, and simulated sensors."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from trackmesh.services.cli.options import (
    Config,
    Connect,
    Inputs,
    LogFormat,
    LogLevel,
    Realm,
    Scenario,
    Seed,
    UnitId,
    say,
    told,
)
from trackmesh.services.runtime import ServiceRuntime, ServiceSettings

StartNs = Annotated[
    int | None,
    typer.Option(
        "--start-ns",
        min=0,
        metavar="NS",
        help="When the scenario began, UTC nanoseconds; default: now. Sensors of one world need the same.",
    ),
]
StartEvery = Annotated[
    float | None,
    typer.Option(
        "--start-every",
        min=1.0,
        metavar="S",
        help="The scenario began at the last multiple of S seconds, and ends at the next. So sensors that are started"
        " apart see one world, and one that is always started again sees it again.",
    ),
]

sim = typer.Typer(help="Simulated sensors: live, or as a recording.", no_args_is_help=True)


def given(**flags: object) -> dict[str, Any]:
    """The flags that were given."""
    return {name: value for name, value in flags.items() if value is not None}


@told
def router(
    listen: Annotated[
        str | None,
        typer.Option(
            "--listen",
            metavar="ENDPOINTS",
            help="Where, separated by commas; default: tcp/127.0.0.1:7447; for other hosts tcp/0.0.0.0:7447.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="JSON5 file, as zenohd reads it.")
    ] = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Run a Zenoh router, where there is no zenohd."""
    from trackmesh.services.router import serve

    settings = ServiceSettings.load(None, given(log_level=log_level, log_format=log_format))
    endpoints = listen.split(",") if listen else []
    raise typer.Exit(serve(endpoints, config, settings.log_level, settings.log_format, settings.heartbeat_file))


@told
def fusion(
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    unit_id: UnitId = None,
    unit_number: Annotated[
        int | None,
        typer.Option("--unit-number", min=0, max=4095, metavar="N", help="Unique in the realm, 0 to 4095; default: 0."),
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option("--sensors", metavar="NAMES", help="Take plots of these only, separated by commas; default: all."),
    ] = None,
    inputs: Inputs = None,
    clock: Annotated[
        Literal["wall", "data"] | None,
        typer.Option("--clock", help="wall: plots are of now; data: they bring their own time (replays)."),
    ] = None,
    black_box: Annotated[
        Path | None,
        typer.Option("--black-box", metavar="FILE", help="Record the engine's inputs, for trackmesh track."),
    ] = None,
    state_file: Annotated[
        Path | None,
        typer.Option("--state-file", metavar="FILE", help="Keep the tracks and their numbers here over restarts."),
    ] = None,
    registration_file: Annotated[
        Path | None,
        typer.Option("--registration-file", metavar="FILE", help="Keep the sensors' biases here over restarts."),
    ] = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Run a fusion unit: plots in, tracks out."""
    from trackmesh.services.fusion.service import run
    from trackmesh.services.fusion.settings import FusionSettings

    flags = given(
        connect=connect, realm=realm, unit_id=unit_id, unit_number=unit_number,
        sensors=sensors, inputs=inputs, clock=clock, black_box=black_box,
        registration_file=registration_file, state_file=state_file,
        log_level=log_level, log_format=log_format,
    )  # fmt: skip
    raise typer.Exit(run(FusionSettings.load(config, flags)))


@told
def emi(
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    unit_id: UnitId = None,
    processes: Annotated[
        int | None,
        typer.Option(
            "--processes", min=0, metavar="N", help="That compute; 0: the service itself; default: all cores."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Requests answered at a time.")
    ] = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Run an EMI service: induction scans in, targets out."""
    from trackmesh.services.emi.service.main import main
    from trackmesh.services.emi.service.settings import EmiSettings

    flags = given(
        connect=connect, realm=realm, unit_id=unit_id, processes=processes, workers=workers, log_level=log_level,
        log_format=log_format,
    )  # fmt: skip
    raise typer.Exit(main(EmiSettings.load(config, flags)))


def world_time_ns(start_ns: int | None, every_s: float | None) -> tuple[int, int | None]:
    """When the scenario began and, if it does, when it ends."""
    now_ns = time.time_ns()
    if every_s is None:
        return (now_ns if start_ns is None else start_ns), None
    if start_ns is not None:
        raise typer.BadParameter("Give --start-ns or --start-every.")
    every_ns = round(every_s * 1e9)
    begin_ns = now_ns - now_ns % every_ns
    return begin_ns, begin_ns + every_ns


def run_simulator(
    kind: str, ident: str, flags: dict[str, Any], config: Path | None, work: Any, end_ns: int | None = None
) -> None:
    """Be a simulated sensor: ``work(runtime)`` until told to stop, or until ``end_ns``."""
    settings = ServiceSettings.load(config, flags | {"unit_id": ident})

    def end(runtime: ServiceRuntime) -> None:
        from trackmesh.sim.live import wait_until

        if end_ns is not None and wait_until(end_ns, runtime.stopping):
            runtime.stop("the scenario has ended")

    def start(runtime: ServiceRuntime) -> None:
        runtime.spawn("end", lambda: end(runtime))

        def loop() -> None:
            work(runtime)
            runtime.stop("the simulation has ended")

        runtime.spawn(kind, loop)
        runtime.set_state("ready")

    raise typer.Exit(ServiceRuntime(kind, settings).run(start))


@sim.command("radar")
@told
def sim_radar(
    scenario: Scenario = "two-radars",
    radar: Annotated[
        str | None, typer.Option("--radar", metavar="NAME", help="Which radar; default: the first.")
    ] = None,
    seed: Seed = 1,
    start_ns: StartNs = None,
    start_every: StartEvery = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Be one rotating radar. Its plots are published sector by sector as the beam turns."""
    from trackmesh.sim.live import run_radar
    from trackmesh.sim.scenario import load_scenario

    world = load_scenario(scenario)
    world.seen_targets()
    radar_id = world.radar(radar).id if radar else world.radars[0].id
    begin_ns, end_ns = world_time_ns(start_ns, start_every)

    def work(runtime: ServiceRuntime) -> None:
        run_radar(
            runtime.bus, world, radar_id, seed, begin_ns, runtime.stopping, keys=runtime.keys, boot_id=runtime.boot_id
        )

    flags = given(connect=connect, realm=realm, log_level=log_level, log_format=log_format)
    run_simulator("sim-radar", radar_id, flags, config, work, end_ns)


@sim.command("truth")
@told
def sim_truth(
    scenario: Scenario = "two-radars",
    seed: Seed = 1,
    start_ns: StartNs = None,
    start_every: StartEvery = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Publish where the targets really are. For scoring."""
    from trackmesh.sim.live import run_truth
    from trackmesh.sim.scenario import load_scenario

    world, (begin_ns, end_ns) = load_scenario(scenario), world_time_ns(start_ns, start_every)

    def work(runtime: ServiceRuntime) -> None:
        run_truth(runtime.bus, world, seed, begin_ns, runtime.stopping, keys=runtime.keys)

    flags = given(connect=connect, realm=realm, log_level=log_level, log_format=log_format)
    run_simulator("sim-truth", world.name, flags, config, work, end_ns)


@sim.command("record")
@told
def sim_record(
    plots: Annotated[Path, typer.Argument(metavar="PLOTS.jsonl", help="File to write.")],
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH.jsonl", help="File to write.")] = None,
    scenario: Scenario = "two-radars",
    seed: Seed = 1,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0.0, metavar="S", help="How much of the scenario; default: all of it."),
    ] = None,
) -> None:
    """Record what the sensors would send. Faster than it happens; the same seed gives the same bytes."""
    from trackmesh.services.cli.progress import progress_bar
    from trackmesh.sim.recording import write_recording
    from trackmesh.sim.scenario import load_scenario

    world = load_scenario(scenario)
    with progress_bar("recording", world.duration_s if seconds is None else seconds) as advance:
        count = write_recording(world, seed, plots, truth, duration_s=seconds, progress=advance)
    say(f"{count} plots of {world.name}, seed {seed}, in {plots}")


@sim.command("emi")
@told
def sim_emi(
    scans: Annotated[Path, typer.Argument(metavar="SCANS.jsonl", help="File to write.")],
    scenario: Scenario = "two-radars",
    seed: Seed = 1,
) -> None:
    """Write simulated induction scans. Of the targets that are buried in a scenario."""
    from trackmesh.protocol.files import RecordWriter
    from trackmesh.sim.emi import scenario_scans
    from trackmesh.sim.scenario import ScenarioError, load_scenario

    world = load_scenario(scenario)
    if world.emi is None:
        raise ScenarioError(f"The scenario {world.name!r} has no [emi] section.")
    simulated = scenario_scans(world.emi, seed)
    with RecordWriter(scans) as file:
        file.write(simulated.batch)
    say(f"{len(simulated.batch.field)} scans in {scans}")
