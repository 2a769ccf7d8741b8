"""Logical scenarios: known distributions are recovered, and concrete scenarios have the parameters that were asked for."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from command_line import run

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.scenarios.index import open_index
from log2sim.scenarios.logical import SAMPLERS, Base, Logical, choose_base, concrete, fit, write_openscenario
from log2sim.scenarios.query import ask
from log2sim.scenarios.tagging import find_tags

pytest.importorskip("duckdb")
pytest.importorskip("pyarrow")


def known(count: int, seed: int = 0):
    """Values of a known joint distribution: speeds and a gap that grows with the first."""
    rng = np.random.default_rng(seed)
    z = rng.multivariate_normal(np.zeros(3), [[1, 0.6, 0], [0.6, 1, 0], [0, 0, 1]], count)
    return np.exp(np.log([20.0, 15.0, 30.0]) + z * [0.15, 0.2, 0.4])


def test_the_parameters_of_a_known_distribution_are_recovered_within_three_sigma() -> None:
    count = 600
    logical = Logical(("a", "b", "gap_m"), known(count))
    drawn = np.log(logical.sample(4096, "sobol", 1))
    sigma = np.array([0.15, 0.2, 0.4])
    assert (np.abs(drawn.mean(axis=0) - np.log([20.0, 15.0, 30.0])) < 3 * sigma / np.sqrt(count)).all()
    # A kernel density is wider than what it was fitted to by its kernels, 600^-0.2 of the spread.
    widened = sigma * np.sqrt(1 + count**-0.4)
    assert (np.abs(drawn.std(axis=0) / widened - 1) < 3 / np.sqrt(2 * count)).all()
    assert logical.correlation[0, 1] == pytest.approx(0.6, abs=3 * (1 - 0.6**2) / np.sqrt(count) + 0.02)
    assert abs(logical.correlation[0, 2]) < 3 / np.sqrt(count)


def test_quantiles_are_the_inverse_of_probabilities() -> None:
    logical = Logical(("a", "b", "c"), known(40))
    p = np.random.default_rng(1).uniform(0.01, 0.99, (100, 3))
    assert logical.cdf(logical.quantile(p)) == pytest.approx(p, abs=1e-3)
    assert (logical.quantile(p) > 0).all()
    signed = Logical(("a",), np.linspace(-3, 5, 20)[:, None])
    assert signed.sample(64).min() < 0


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_draws_repeat_by_their_seed(sampler) -> None:
    logical = Logical(("a", "b", "c"), known(40))
    assert np.array_equal(logical.sample(33, sampler, 5), logical.sample(33, sampler, 5))
    assert not np.array_equal(logical.sample(33, sampler, 5), logical.sample(33, sampler, 6))
    assert logical.sample(33, sampler, 5).shape == (33, 3)


def test_one_value_for_all_stays_that_value() -> None:
    logical = Logical(("a", "b"), np.column_stack([np.full(8, 12.0), np.linspace(1, 2, 8)]))
    assert logical.sample(16)[:, 0] == pytest.approx(12.0, rel=1e-3)


@pytest.fixture(scope="module")
def found(traffic_folder):
    index = open_index(traffic_folder, jobs=1)
    rows = ask(index, "cut_in").rows
    logical = fit(rows)
    chosen = choose_base(logical, rows)
    return logical, Base.of(Scenario.load(traffic_folder / chosen["file"]), chosen)


def test_concrete_scenarios_have_the_parameters_that_were_asked_for(found) -> None:
    logical, base = found
    assert logical.names == ("agent.speed_mps", "other.speed_mps", "gap_m")
    asked = np.array([[24.0, 20.0, 12.0], [26.0, 25.0, 30.0], [22.0, 23.0, 20.0]])
    for values, (made, problems) in zip(asked, concrete(base, logical, asked)):
        assert problems == ()
        (tag,) = [g for g in find_tags(made) if g.tag == "cut_in"]
        agents = {a.id: a for a in made.agents}
        assert agents[tag.agent].at([tag.t_s]).speed_mps[0] == pytest.approx(values[0], abs=0.5)
        assert agents[tag.other].at([tag.t_s]).speed_mps[0] == pytest.approx(values[1], abs=0.5)
        assert tag.quantities["gap_m"] == pytest.approx(values[2], abs=1.5)


def test_the_base_itself_is_what_was_found(found) -> None:
    logical, base = found
    values = np.array([[base.row[name] for name in logical.names]])
    ((made, problems),) = concrete(base, logical, values)
    assert problems == ()
    (tag,) = [g for g in find_tags(made) if g.tag == "cut_in"]
    assert tag.quantities["gap_m"] == pytest.approx(base.row["gap_m"], abs=0.7)
    assert tag.t_s == pytest.approx(base.moment_s[tag.agent], abs=0.3)


def test_what_no_vehicle_can_drive_and_what_collides_is_said(found) -> None:
    logical, base = found
    values = np.array([[110.0, 20.0, 20.0], [20.0, 20.0, -3.0]])
    (_, too_fast), (_, collides) = concrete(base, logical, values)
    assert any("limit" in line for line in too_fast)
    assert any("collide" in line for line in collides)


def test_openscenario_plays_the_concrete_scenarios(found, tmp_path) -> None:
    """Times of vertices, scaled and shifted as each set of values says, lead where the concrete scenario is."""
    logical, base = found
    values = np.array([[24.0, 20.0, 12.0], [26.0, 25.0, 30.0]])
    timings = [base.timings(logical, v) for v in values]
    write_openscenario(base, timings, tmp_path / "xosc")
    root = ElementTree.parse(tmp_path / "xosc" / "scenario.xosc").getroot()
    declared = {
        p.get("name"): p.get("value") for p in root.iter("ParameterDeclaration") if p.get("parameterType") == "double"
    }
    assert declared == {"scale_0": "1", "offset_0": "0", "scale_1": "1", "offset_1": "0"}
    tree = ElementTree.parse(tmp_path / "xosc" / "variations.xosc").getroot()
    assert tree.find("FileHeader").get("revMinor") == "2"
    assert tree.find("ParameterValueDistribution/ScenarioFile").get("filepath") == "scenario.xosc"
    sets = tree.findall(
        "ParameterValueDistribution/Deterministic/DeterministicMultiParameterDistribution/ValueSetDistribution/ParameterValueSet"
    )
    assert len(sets) == 2
    for chosen, (made, _) in zip(sets, concrete(base, logical, values)):
        value = {f"${a.get('parameterRef')}": float(a.get("value")) for a in chosen}
        followed = [e for e in root.iter("Event") if e.get("name").endswith(" follows")]
        assert len(followed) == 2
        for event, agent in zip(followed, made.agents):
            timing = event.find(".//Timing")
            scale, offset = value[timing.get("scale")], value[timing.get("offset")]
            vertices = event.findall(".//Vertex")
            t = np.array([float(v.get("time")) for v in vertices]) * scale + offset
            world = [v.find(".//WorldPosition") for v in vertices]
            x, y = (np.array([float(p.get(k)) for p in world]) for k in ("x", "y"))
            at = np.array([1.0, 4.0, made.duration_s - 1.0])
            state = agent.at(at)
            assert np.interp(at, t, x) - state.x_m == pytest.approx(np.interp(at, t, x)[0] - state.x_m[0], abs=0.05)
            assert np.interp(at, t, y) - state.y_m == pytest.approx(np.interp(at, t, y)[0] - state.y_m[0], abs=0.05)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "found nothing"),
        ([{"tag": "in_lane", "agent.speed_mps": 3.0}] * 9, "expected hits of one of"),
        ([{"tag": "cut_in", "agent.speed_mps": 3.0}, {"tag": "overtaking"}], "found cut_in, overtaking"),
        ([{"tag": "overtaking", "agent.speed_mps": 9.0, "other.speed_mps": 7.0, "other": "b"}] * 3, "needs 5 or more"),
    ],
)  # fmt: skip
def test_hits_without_a_distribution_are_refused(rows, said) -> None:
    with pytest.raises(ConfigError, match=said):
        fit(rows)


def test_the_command(traffic_folder, tmp_path) -> None:
    ran = run(
        "vary",
        traffic_folder,
        "overtaking and relative_speed_mps > 2",
        "-o",
        tmp_path / "v",
        "--count",
        6,
        "--openscenario",
    )
    assert ran.code == 0, ran.err
    about = json.loads((tmp_path / "v" / "logical.json").read_text())
    assert set(about["parameters"]) == {"agent.speed_mps", "other.speed_mps"}
    written = sorted((tmp_path / "v").glob("*/scenario.json"))
    assert 1 <= len(written) <= 6
    assert "overtaking" in {g.tag for g in find_tags(Scenario.load(written[0]))}
    import pyarrow.parquet as pq

    table = pq.read_table(tmp_path / "v" / "variations.parquet").to_pylist()
    assert len(table) == 6
    assert sum(row["file"] is not None for row in table) == len(written)
    assert "exists already" in run("vary", traffic_folder, "overtaking", "-o", tmp_path / "v").line
    assert "cut_in" in run("vary", traffic_folder, "standing", "-o", tmp_path / "w").line
    closest = run("vary", traffic_folder, "cut_in and gap_m < 0.001", "-o", tmp_path / "w").line
    assert "without 'gap_m < 0.001' there are" in closest
    nothing = run(
        "vary", traffic_folder, "cut_in and gap_m < 0.001 and ttc_s < 0", "-o", tmp_path / "w", "--probability", 0.9
    )
    assert "each alone: 'cut_in' " in nothing.line
    assert "'probability >= 0.9' " in nothing.line
    assert not (tmp_path / "w").exists()
