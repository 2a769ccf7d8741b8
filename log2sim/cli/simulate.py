"""What happens in a scenario: simulated, predicted, and as sensors would record it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError, ScenarioError


def replay(
    scenario: opt.ScenarioPath,
    out: Annotated[Path | None, opt.write_to("FILE", "Replay file to write.")] = None,
    mode: Annotated[str, opt.choose(
        "--mode", "pid|exact",
        "pid: vehicles follow their trajectories by a controller; exact: no controller.")] = "pid",
    model: Annotated[str, opt.choose(
        "--model", "auto|kinematic|dynamic|single-track",
        "Vehicle model, or a plug-in; auto: by how hard each vehicle drives.")] = "auto",
    dt: Annotated[float, opt.option("Time step in s, from 0.0005 to 1.", "S")] = 0.01,
    ego: Annotated[str | None, opt.option(
        "Policy that drives the ego: a plug-in, or of a module or file.",
        "NAME|MODULE:ATTRIBUTE|FILE.py:ATTRIBUTE")] = None,
    log: Annotated[Path | None, opt.option(
        "--ego: what the policy sees by its observations' sweep and image comes from this log.", "LOG")] = None,
    recorded: Annotated[Path | None, opt.option(
        "--log: what was reconstructed from it, where the scenario is an edit. [default: the scenario]",
        "FILE")] = None,
    warn: Annotated[str | None, opt.choose(
        "--warn", "vehicle|road|both",
        "Warn the ego, or without one each vehicle, of collisions by what the sensors at these ends observe.")] = None,
    brake: Annotated[bool, opt.option("With --warn: the ego brakes when it is warned.", None, "--brake")] = False,
    horizon: Annotated[float, opt.option("--warn: predict collisions for so long, in s.", "S")] = 5.0,
    reaction: Annotated[float, opt.option("--warn: from the warning until the brakes work, in s.", "S")] = 1.0,
    deceleration: Annotated[float, opt.option("--warn: how hard the ego brakes, in m/s2.", "MPS2")] = 8.0,
    agents: Annotated[str, opt.choose(
        "--agents", "scenario|reactive",
        "Behavior of the other agents: as the scenario says, or braking to avoid collisions.")] = "scenario",
    react: Annotated[str | None, opt.option("Make only these agents reactive.", "ID,ID")] = None,
    foresight: Annotated[str, opt.choose(
        "--foresight", "path|motion",
        "What reactive agents expect of others: path: where the scenario has them go; motion: as they moved so far.")] = "path",
    confidence: Annotated[float | None, opt.option(
        "Leave out agents with a lower confidence instead of the quarantined; 0: none. The ego stays.", "MIN")] = None,
    drop_doubtful: opt.DropDoubtful = False,
    simulator: Annotated[str, opt.choose(
        "--simulator", "own|carla", "own, or carla: agents move in a CARLA server.")] = "own",
    host: Annotated[str | None, opt.option("carla: address of the server.", "NAME", default="127.0.0.1")] = None,
    port: Annotated[int | None, opt.option("carla: port of the server.", "N", min=1, max=65535, default="2000")] = None,
    map: Annotated[str | None, opt.option("carla: map to load first.", "TOWN|FILE.xodr")] = None,
    strict: Annotated[bool, opt.option(
        "Exit 6 when a limit is exceeded: --limit, new collisions, distance from the path.", None, "--strict")] = False,
    limit: Annotated[list[str] | None, opt.option(
        "Report agents beyond this limit, e.g. min_ttc_s=1; see --strict.", "METRIC=VALUE")] = None,
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Simulate a scenario.

    Examples
    --------
    log2sim replay s.json -o replay.json
    log2sim replay s.json --ego policy.py:drive --agents reactive
    log2sim replay s.json --ego samples/egos.py:BrakeForPoints --log samples/crossing
    log2sim replay s.json --warn road --brake --strict
    """
    from dataclasses import replace as changed

    from log2sim.cli.change import ids_of
    from log2sim.datatypes import Scenario, explain_doubt, format_confidence
    from log2sim.datatypes.agent import MAX_LISTED
    from log2sim.export.checks import doubtful_note, export_notes
    from log2sim.files.documents import check_targets
    from log2sim.simulation.expected_motion import WarningSettings
    from log2sim.simulation.metrics.all_metrics import check_limits, parse_limits, require_strict, summarize
    from log2sim.simulation.policy import load_policy
    from log2sim.simulation.runner import external_simulator
    from log2sim.simulation.runner import replay as run
    from log2sim.simulation.warnings import BrakeWhenWarned, warnable
    from log2sim.simulation.warnings import warn as find_warnings

    check_targets(out, overwrite=overwrite)
    if out is not None and out.resolve() == scenario.resolve():
        raise ConfigError(f"{out}: is the scenario itself, which a replay must not replace; choose another name")
    if react is not None and agents == "reactive":
        raise ConfigError("--react selects the reactive agents and --agents reactive selects all: give one of the two")
    if foresight != "path" and react is None and agents != "reactive":
        raise ConfigError("--foresight: nobody reacts; add --agents reactive or --react")
    limits = parse_limits(limit or ())
    if log is not None and ego is None:
        raise ConfigError("--log: is what the policy of --ego sees; add --ego")
    if recorded is not None and log is None:
        raise ConfigError("--recorded: was reconstructed from the log of --log; add --log")
    if brake and (warn is None or ego is not None):
        raise ConfigError("--brake: brakes when the ego is warned; add --warn, and leave out --ego")
    warning = None if warn is None else WarningSettings(warn, horizon, reaction_s=reaction, brake_mps2=deceleration)
    loaded = Scenario.load(scenario)
    chosen = agents if react is None else list(ids_of(loaded, [react]))
    # The scenario without the agents that are not wanted, and these with why.
    kept = loaded.active if confidence is None else loaded.trusted(confidence)
    there = {a.id for a in kept.agents}
    left_out = {a.id: format_confidence(a) for a in loaded.agents if a.id not in there}
    if drop_doubtful:
        left_out |= {a.id: explain_doubt(a) for a in kept.doubtful if a is not kept.ego}
        kept = kept.drop_doubtful()
    if warning is not None:
        warnable(kept if confidence is not None else kept.active)
    policy = load_policy(ego) if ego is not None else BrakeWhenWarned(warning) if brake else None
    moved_by = external_simulator(simulator, host, port, map)
    with progress() as report_progress:
        if log is not None and policy is not None:
            from log2sim.localization.choice import localize_like
            from log2sim.logs.opening import open_log
            from log2sim.resim.simulate import simulate, with_sensors

            source = loaded if recorded is None else Scenario.load(recorded)
            opened = localize_like(open_log(log), source.provenance)
            now = kept.aligned_to(source)
            policy = with_sensors(policy, simulate(opened, source, now, cameras=True, progress=report_progress))
        result = run(
            kept, mode=mode, model=model, dt_s=dt, ego=policy, agents=chosen, foresight=foresight, host=moved_by,
            quarantined=confidence is not None, progress=partial(report_progress, "replay"),
        )  # fmt: skip
    warned = None if warning is None else find_warnings(kept, result, ends=warning.ends, settings=warning)
    result = changed(result, left_out=left_out, warnings=warned)
    if out is not None:
        result.save(out)
    opt.tell(summarize(result, limit=None if verbose else MAX_LISTED))
    note = doubtful_note(kept, kept)
    opt.say_all("note", [*([note] if note else []), *export_notes(kept)])
    opt.report_written(out)
    if strict:
        require_strict(result, limits)
    opt.say_all("limit exceeded", check_limits(result, limits))


def predict(
    scenario: opt.ScenarioPath,
    horizon: Annotated[float, opt.option("Longest prediction in s, from 0.1 to 10.", "S")] = 3.0,
    method: Annotated[
        str | None, opt.option("Only these methods: velocity, turn, smoothed, path.", "A,B", default="all")
    ] = None,
    out: Annotated[Path | None, opt.write_to("FILE", "Figures file to write.")] = None,
    positions: Annotated[
        bool, opt.option("With --out: write every predicted position with its sigma, too.", None, "--positions")
    ] = False,
    overwrite: opt.Overwrite = False,
) -> None:
    """Predict each agent at each tick from its past, and estimate how far off that is.

    Examples
    --------
    log2sim predict s.json --horizon 2 -o prediction.json
    """
    from log2sim.datatypes import Scenario
    from log2sim.files.documents import check_targets, write_json
    from log2sim.simulation.prediction.prediction import METHODS, format_figures, predict_scenario, prediction_document

    check_targets(out, overwrite=overwrite)
    if positions and out is None:
        raise ConfigError("--positions: there is no file to write them to; name one with --out")
    methods = tuple(METHODS) if method is None else tuple(dict.fromkeys(m.strip() for m in method.split(",")))
    loaded = Scenario.load(scenario).active
    document = prediction_document(loaded, predict_scenario(loaded, horizon, methods=methods), with_positions=positions)
    if out is not None:
        write_json(out, document)
    opt.tell(format_figures(document))
    if loaded.is_reconstruction:
        opt.tell("note: the states were smoothed over the whole log and depend a little on what came next")
    opt.report_written(out)


def resimulate(
    scenario: opt.ScenarioPath,
    log: Annotated[Path, opt.option("Log that the scenario was reconstructed from.", "LOG")],
    out: Annotated[Path, opt.write_to("DIR", "Log folder to write.")],
    replay: Annotated[Path | None, opt.option(
        "What happens now: a replay or an edit of the scenario. [default: the scenario]", "FILE")] = None,
    sensors: Annotated[str | None, opt.option(
        "LiDARs and cameras that are simulated.", "A,B", default="all LiDARs")] = None,
    cameras: Annotated[bool, opt.option("All cameras, too.", None, "--cameras")] = False,
    sequence: Annotated[str | None, opt.option("Sequence of a log with several.", "NAME")] = None,
    film: Annotated[Path | None, opt.option(
        "Film of a LiDAR, and a camera where they are simulated: recorded, simulated, now.", "FILE.webm")] = None,
    seed: Annotated[int, opt.option("Seed of noise and lost returns.", min=0)] = 0,
    overwrite: opt.Overwrite = False,
) -> None:  # fmt: skip
    """Write what the LiDARs and cameras of a log would have recorded from where the ego drives now, among its agents.

    Examples
    --------
    log2sim resimulate s.json --log samples/crossing -o simulated/
    log2sim edit s.json --lateral ego=2 -o left.json
    log2sim resimulate s.json --log samples/crossing --replay left.json -o from_the_left/ --cameras --film left.webm
    """
    from log2sim.datatypes import Scenario
    from log2sim.files.documents import check_targets, read_json
    from log2sim.localization.choice import localize_like
    from log2sim.logs.native.writer import refuse_target
    from log2sim.logs.opening import open_log
    from log2sim.resim.simulate import resimulate as run
    from log2sim.simulation.result import Replay, to_scenario
    from log2sim.visualization.plot.encoding import choose_film_file
    from log2sim.visualization.sensor_film import write_film

    refuse_target(out, overwrite=overwrite)
    filmed = None
    if film is not None:  # before the long work
        if film.suffix.lower() not in (".mp4", ".webm"):
            raise ConfigError(f"--film {film}: a film's name must end in .mp4 or .webm")
        filmed = choose_film_file(film)
        check_targets(filmed.path, overwrite=overwrite)
    now = source = Scenario.load(scenario)
    if replay is not None:
        document = read_json(replay, ScenarioError)
        if isinstance(document, dict) and "replay_version" in document:
            now = to_scenario(Replay.load(replay), source)
        else:
            now = Scenario.load(replay).aligned_to(source)
    with progress() as report:
        recorded = localize_like(open_log(log, sequence=sequence), source.provenance)
        notes = run(
            recorded, source, now, out, sensors=opt.split_names(sensors), cameras=cameras, seed=seed, overwrite=overwrite, progress=report,
            then=lambda simulation: None if filmed is None else write_film(simulation, source, filmed),
        )  # fmt: skip
    opt.say_all("note", (*notes, *([filmed.note] if filmed is not None and filmed.note else [])))
    opt.report_written(out, None if filmed is None else filmed.path)
