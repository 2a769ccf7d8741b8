"""Conditions on tags, against a search of the same rows by plain Python; the index that keeps them; what is wrong is said."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks.tag_worlds import traffic
from command_line import run

from log2sim.datatypes import TAGS
from log2sim.errors import ConfigError, ScenarioError
from log2sim.scenarios.hits import write_hits
from log2sim.scenarios.index import INDEX_FILE, Index, open_index, table_of_rows
from log2sim.scenarios.query import ask
from log2sim.scenarios.tagging import tag

pytest.importorskip("duckdb")
pytest.importorskip("pyarrow")


def index_of(rows) -> Index:
    return Index(Path(), table_of_rows(rows), 3)


def random_rows(seed: int, count: int = 300):
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        start = float(rng.uniform(0, 20))
        row = {
            "file": f"s{rng.integers(3)}/scenario.json", "scenario": "s", "tag": str(rng.choice(["cut_in", "hard_braking", "following"])),
            "agent": f"car-{rng.integers(4)}", "other": str(rng.choice(["ego", "car-9"])), "start_s": start, "t_s": start + 1,
            "end_s": start + float(rng.uniform(1, 3)), "probability": float(rng.uniform(0, 1)), "gap_m": float(rng.uniform(0, 40)),
            "ego.speed_mps": float(rng.uniform(0, 30)), "ego.category": str(rng.choice(["car", "truck"])),
        }  # fmt: skip
        if rng.random() < 0.5:
            row["ttc_s"] = float(rng.uniform(0, 6))
        rows.append(row)
    return rows


def with_tag(rows, row, name):
    """Rows of a tag that share a road user and a time with one."""
    return [
        r for r in rows
        if r["tag"] == name and r["file"] == row["file"] and r["start_s"] <= row["end_s"] and r["end_s"] >= row["start_s"]
        and {r["agent"], r["other"]} & {row["agent"], row["other"]}
    ]  # fmt: skip


CASES = {
    "cut_in and ttc_s < 2 and ego.speed_mps > 10": lambda r, rows: r["tag"] == "cut_in" and r.get("ttc_s", 9) < 2 and r["ego.speed_mps"] > 10,
    "cut_in or following and gap_m >= 20": lambda r, rows: r["tag"] == "cut_in" or (r["tag"] == "following" and r["gap_m"] >= 20),
    "cut_in and not ttc_s < 2": lambda r, rows: r["tag"] == "cut_in" and r.get("ttc_s", 0) >= 2,
    "following and 5 < gap_m <= 10 and other == 'ego'": lambda r, rows: r["tag"] == "following" and 5 < r["gap_m"] <= 10 and r["other"] == "ego",
    "hard_braking and ego.category in ('truck', 'bus')": lambda r, rows: r["tag"] == "hard_braking" and r["ego.category"] == "truck",
    "cut_in and gap_m / ego.speed_mps - 1 > -0.5": lambda r, rows: r["tag"] == "cut_in" and r["gap_m"] / r["ego.speed_mps"] > 0.5,
    "cut_in and abs(gap_m - 20) < 5": lambda r, rows: r["tag"] == "cut_in" and abs(r["gap_m"] - 20) < 5,
    "cut_in and hard_braking": lambda r, rows: r["tag"] == "cut_in" and bool(with_tag(rows, r, "hard_braking")),
    "cut_in and not hard_braking": lambda r, rows: r["tag"] == "cut_in" and not with_tag(rows, r, "hard_braking"),
    "cut_in and hard_braking.gap_m > 35": lambda r, rows: r["tag"] == "cut_in" and any(h["gap_m"] > 35 for h in with_tag(rows, r, "hard_braking")),
    "cut_in.gap_m > 30 and cut_in": lambda r, rows: r["tag"] == "cut_in" and r["gap_m"] > 30,
}  # fmt: skip


@pytest.mark.parametrize("condition", CASES)
def test_conditions_mean_what_they_say(condition) -> None:
    rows = random_rows(1)
    found = ask(index_of(rows), condition, min_probability=0.0).rows
    expected = [r for r in rows if CASES[condition](r, rows)]
    assert 0 < len(expected) < len(rows)

    def key(r):
        return (r["file"], r["tag"], r["agent"], r["t_s"])

    assert sorted(map(key, found)) == sorted(map(key, expected))


def test_only_probable_ones_are_found_unless_the_condition_says_which() -> None:
    rows = random_rows(2)
    found = ask(index_of(rows), "cut_in", min_probability=0.7).rows
    assert len(found) == sum(r["tag"] == "cut_in" and r["probability"] >= 0.7 for r in rows)
    assert [r["probability"] for r in found] == sorted((r["probability"] for r in found), reverse=True)
    assert len(ask(index_of(rows), "cut_in and probability < 0.2").rows) == sum(
        r["tag"] == "cut_in" and r["probability"] < 0.2 for r in rows
    )


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("cut_inn", "did you mean 'cut_in'"),
        ("cut_in and tct_s < 2", "did you mean 'ttc_s'"),
        ("cut_in and ego.sped_mps > 2", "did you mean 'speed_mps'"),
        ("cut_in and hard_braking.gap > 2", "did you mean 'gap_m'"),
        ("cut_in and ttc_s", "expected a tag or a comparison"),
        ("cut_in < 3", "compares"),
        ("ttc_s < 'two'", "texts need quotes"),
        ("agent == ego", "neither a tag nor a field"),
        ("cut_in and", "invalid syntax"),
        ("", "1 to 2000"),
        ("__import__('os').system('touch x')", "not understood"),
        ("(lambda: 1)()", "not understood"),
        ("cut_in and " * 900 + "cut_in", "letters"),
        ("(" * 300 + "cut_in" + ")" * 300, ""),
        ("not " * 250 + "cut_in", "parts"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_condition_is_said(condition, said) -> None:
    with pytest.raises(ConfigError, match="condition") as caught:
        ask(index_of(random_rows(1)), condition)
    assert said in str(caught.value)


def test_texts_are_values_and_never_part_of_the_query() -> None:
    rows = random_rows(3)
    index = index_of(rows)
    assert ask(index, "agent == \"x' OR '1'='1\"").rows == ()
    assert ask(index, "agent == '; DROP TABLE tags; --'").rows == ()
    odd = [{**rows[0], "agent": "o'x\"; DROP TABLE tags", "probability": 1.0}]
    assert len(ask(index_of(odd), repr(odd[0]["agent"]) + " == agent").rows) == 1
    with pytest.raises(ConfigError):
        ask(index, "read_csv('/etc/passwd')")


def test_an_empty_result_says_what_was_closest() -> None:
    rows = [
        {**r, "ttc_s": 2.5 + k / 10, "ego.speed_mps": 12.0, "probability": 0.9}
        for k, r in enumerate(random_rows(4, 40))
    ]
    found = ask(index_of(rows), "cut_in and ttc_s < 2 and ego.speed_mps > 10")
    nearest = min(r["ttc_s"] for r in rows if r["tag"] == "cut_in")
    assert found.rows == ()
    (line,) = found.closest
    count = sum(r["tag"] == "cut_in" for r in rows)
    assert line.startswith(f"without 'ttc_s < 2' there are {count}, the nearest with ttc_s = {nearest:.4g}: cut_in of")
    assert ask(index_of(rows), "cut_in and ttc_s < 2 and ego.speed_mps > 20").closest[0].startswith("each alone:")
    blank = [{k: v for k, v in r.items() if k != "ttc_s"} if r["tag"] == "cut_in" else r for r in rows]
    assert ask(index_of(blank), "cut_in and ttc_s < 2").closest == (
        f"without 'ttc_s < 2' there are {count}, of none of which ttc_s is known",
    )


def test_the_index_follows_its_files(tmp_path) -> None:
    worlds = [traffic(k, count=4, duration_s=8.0).scenario for k in (3, 4, 5)]
    for k, s in enumerate(worlds[:2]):
        s.save(tmp_path / f"log-{k}" / "scenario.json")
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "log-9").mkdir()
    (tmp_path / "log-9" / "scenario.json").write_text("{")
    first = open_index(tmp_path, jobs=1)
    assert first.scenarios == 3
    assert len(first.problems) == 1
    assert "not valid JSON" in first.problems[0]
    expected = {
        (f"log-{k}/scenario.json", g.tag, g.agent, g.t_s) for k, s in enumerate(worlds[:2]) for g in tag(s).tags
    }

    def keys(index):
        return {(r["file"], r["tag"], r["agent"], r["t_s"]) for r in index.table.to_pylist()}

    assert keys(first) == expected
    stamp = (tmp_path / INDEX_FILE).stat().st_mtime_ns
    again = open_index(tmp_path, jobs=1)
    assert keys(again) == expected
    assert again.problems == first.problems
    assert (tmp_path / INDEX_FILE).stat().st_mtime_ns == stamp
    (tmp_path / "log-0" / "scenario.json").unlink()
    worlds[2].save(tmp_path / "log-1" / "scenario.json")
    os.utime(tmp_path / "log-1" / "scenario.json", ns=(1, 1))
    assert keys(open_index(tmp_path, jobs=1)) == {
        ("log-1/scenario.json", g.tag, g.agent, g.t_s) for g in tag(worlds[2]).tags
    }
    (tmp_path / INDEX_FILE).write_bytes(b"PAR1 damaged")
    assert keys(open_index(tmp_path, jobs=1)) == {
        ("log-1/scenario.json", g.tag, g.agent, g.t_s) for g in tag(worlds[2]).tags
    }


def test_a_folder_without_scenarios_is_refused(tmp_path) -> None:
    with pytest.raises(ScenarioError, match="holds no scenario"):
        open_index(tmp_path)


def test_quantities_of_a_file_cannot_take_the_place_of_what_names_it(tmp_path) -> None:
    tagged = tag(traffic(3, count=4, duration_s=8.0).scenario).to_dict()
    tagged["tags"][0]["quantities"] = {"file": 7.0, "tag": 8.0, "probability": 9.0, "start_s": 5.0}
    (tmp_path / "scenario.json").write_text(json.dumps(tagged))
    (row,) = [r for r in open_index(tmp_path, jobs=1).table.to_pylist() if r["t_s"] == tagged["tags"][0]["t_s"]][:1]
    assert row["file"] == "scenario.json"
    assert row["tag"] in TAGS
    assert row["probability"] <= 1


def test_the_page_escapes_what_it_shows(tmp_path) -> None:
    s = traffic(3, count=4, duration_s=8.0).scenario
    s.save(tmp_path / "<b>" / "scenario.json")
    index = open_index(tmp_path, jobs=1)
    found = ask(index, "overtaking or following or cut_in")
    assert found.rows
    write_hits(tmp_path / "hits.html", index, "gap_m < 5 and '<script>' == tag", found.rows)
    text = (tmp_path / "hits.html").read_text()
    assert "<script>" not in text
    assert "<b>/scenario" not in text
    assert text.count("<svg") == len(found.rows)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("logs")
    for k in (3, 4):
        traffic(k, lanes=True).scenario.save(root / f"log-{k}" / "scenario.json")
    return root


def test_the_commands(folder, tmp_path) -> None:
    counted = run("find", folder, "--jobs", 1)
    assert counted.code == 0
    assert "overtaking" in counted.out
    fields = run("find", folder, "--fields")
    assert "ego.speed_mps" in fields.out
    asked = f"find {folder} 'overtaking and relative_speed_mps > 1'"
    ran = run(f"{asked} -o {tmp_path}/hits.html --table {tmp_path}/hits.parquet")
    assert ran.code == 0
    assert "hits in 2 scenarios" in ran.out
    rows = json.loads(run(f"{asked} --json").out)
    assert len(rows) == (tmp_path / "hits.html").read_text().count("<article>")
    assert all(r["tag"] == "overtaking" and r["relative_speed_mps"] > 1 for r in rows)
    assert "did you mean 'overtaking'" in run("find", folder, "overtakin").line
    one = run("find", folder / "log-3" / "scenario.json", "overtaking")
    assert "in 1 scenario" in one.out
    tagged = run(
        "tag", folder / "log-3" / "scenario.json", "-o", tmp_path / "t.json", "--criticality", tmp_path / "c.csv", "-v"
    )
    assert tagged.code == 0
    assert "lane_change" in tagged.out
    assert (tmp_path / "c.csv").read_text().startswith("agent,other,t_s,gap_m,")
    assert "exists already" in run("tag", folder / "log-3" / "scenario.json", "-o", tmp_path / "t.json").line


def test_a_question_to_an_index_that_is_there_loads_neither_tagging_nor_pandas(folder) -> None:
    """Each takes longer to import than the question."""
    run("find", folder, "--jobs", 1)
    code = f"""import sys
from pathlib import Path
from log2sim.scenarios.index import open_index
from log2sim.scenarios.query import ask
print(len(ask(open_index(Path({str(folder)!r})), "overtaking").rows) > 0)
print([m for m in ("pandas", "scipy", "shapely", "log2sim.scenarios.tagging", "log2sim.simulation") if m in sys.modules])"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "True\n[]\n"


def test_a_hit_is_opened_at_its_moment(folder, tmp_path, monkeypatch) -> None:
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    (row,) = json.loads(run("find", folder, "overtaking", "--json").out)[:1]
    ran = run("find", folder, "overtaking", "-o", tmp_path / "hits.html", "--open", 1)
    assert ran.code == 0
    assert opened == [f"{(tmp_path / 'hits-1.html').resolve().as_uri()}#t={row['t_s']:.2f}&agent={row['agent']}"]
    assert (tmp_path / "hits-1.html").stat().st_size > 10_000
    assert "there are" in run("find", folder, "overtaking", "--open", 10_000).line
