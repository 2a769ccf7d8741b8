"""What README.md and the cookbook tell people to type works: commands and options exist, links lead somewhere, code imports.

Blocks marked `sh` and `python` run as printed, in order. Blocks marked `console` need data of the reader's or run the tests
themselves, and blocks marked `text` are no commands: they are only parsed.
"""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import demo
import pytest
import typer
from command_line import run
from entry import commands_in

from log2sim.cli import entry
from log2sim.logs.ros.messages import read_settings

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "samples/cookbook").glob("*.md"))}
FRONT = (ROOT / "README.md").read_text(encoding="utf-8")
README = "\n".join([FRONT, *PAGES.values()])
GROUP = typer.main.get_group(entry.app)
SAMPLE_S = 3.6  # the latest moment that a line names, and a little more


def test_documents_name_tools_that_exist() -> None:
    pages = [*ROOT.glob("*.md"), ROOT / "log2sim/README.md", *(ROOT / "samples/cookbook").glob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    named = {"bench": set(commands_in("benchmarks")), "fit": set(commands_in("fits"))}
    found = re.findall(r"\b(bench|fit)\.py (\w+)", text)
    assert all(name in named[tool] or name == "NAME" for tool, name in found)
    assert all((ROOT / f"tools/{name}").is_file() for name in re.findall(r"tools/(\w+\.(?:py|sh))", text))


def blocks() -> Iterator[str]:
    """Code blocks, fenced or indented by four columns."""
    yield from re.findall(r"^```[^\n]*\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
    rest = re.sub(r"^```[^\n]*\n.*?^```", "", README, flags=re.MULTILINE | re.DOTALL)
    for block in re.findall(r"(?:^(?: {4}.*)?\n)+", rest, flags=re.MULTILINE):
        lines = [line[4:] for line in block.split("\n") if line.startswith("    ")]
        if lines:
            yield "\n".join(lines)


def runnable(page: str) -> list[tuple[str, str]]:
    """Blocks marked `sh` and `python`."""
    return re.findall(r"^```(sh|python)\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)


def script_of(page: str) -> str:
    """The blocks as one bash script that stops at the first line that fails and names it."""
    lines = ["set -Eeo pipefail", """trap 'echo "failed: $BASH_COMMAND" >&2' ERR"""]
    for language, block in runnable(page):
        lines.append(block if language == "sh" else f"python - <<'END_OF_PYTHON'\n{block}END_OF_PYTHON")
    return "\n".join(lines)


def commands() -> list[str]:
    """Command lines of log2sim in code blocks, comments off and continued lines joined, and those within sentences."""
    joined = "\n".join(blocks()).replace("\\\n", " ")
    lines = [re.sub(r"\s+#.*", "", line).strip().removeprefix("$ ") for line in joined.split("\n")]
    inline = re.findall(r"`(log2sim [^`\n]+)`", README)
    return [line for line in (*lines, *inline) if re.match(r"log2sim \w", line)]


def parse(line: str) -> None:
    """Parse as the program would, without running it."""
    name, *arguments = shlex.split(line)[1:]
    assert name in GROUP.commands, f"no command '{name}' in: {line}"
    GROUP.commands[name].make_context(name, arguments)


@pytest.mark.parametrize("line", commands())
def test_commands_of_the_readme_parse(line: str) -> None:
    parse(line)


def test_commands_of_the_demo_parse() -> None:
    for command in demo.COMMANDS:
        parse(shlex.join(["log2sim", *command, "--overwrite"]))


def test_every_command_is_documented() -> None:
    for name, command in GROUP.commands.items():
        assert command.help, name
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"{name} {parameter.name}"


def test_links_lead_to_files_and_headings() -> None:
    wrong = []
    for page in (
        ROOT / "README.md",
        ROOT / "BENCHMARKS.md",
        ROOT / "log2sim/README.md",
        *(ROOT / "samples/cookbook").glob("*.md"),
    ):
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            path, _, heading = target.partition("#")
            linked = page.parent / path if path else page
            if target.startswith("http") or (linked.exists() and (not heading or heading in headings(linked))):
                continue
            wrong.append(f"{page.name}: {target}")
    assert not wrong


def headings(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    found = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in found}


def test_names_that_python_code_imports_exist() -> None:
    seen = []
    for block in blocks():
        for node in _imports(block):
            assert node.module is not None
            module = importlib.import_module(node.module)
            seen += [getattr(module, alias.name) for alias in node.names]
    assert seen, "the README shows no use as a library"


def _imports(block: str) -> list[ast.ImportFrom]:
    try:
        tree = ast.parse(block)
    except SyntaxError:
        return []
    return [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("log2sim")]


@pytest.fixture
def fresh_checkout(tmp_path: Path) -> Path:
    """What a clone of this checkout with its uncommitted work would hold; of the sample every other record of its first seconds."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs git to tell the files of the checkout from others")
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            target = tmp_path / "log2sim" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
    sample, part = tmp_path / "log2sim/samples/crossing", tmp_path / "part"
    assert run("convert", sample, "--stop", SAMPLE_S, "--out", part).code == 0
    (sample / "truth.json").rename(part / "truth.json")
    stamps = set[str]()
    for table in (*part.glob("*/index.csv"), part / "labels/boxes_2d.csv"):
        head, *rows = table.read_text().splitlines()
        kept = rows[::2] if table.name == "index.csv" else [row for row in rows if row.split(",")[0] in stamps]
        stamps.update(row.split(",")[0] for row in kept)
        table.write_text("\n".join([head, *kept]) + "\n")
    shutil.rmtree(sample)
    part.rename(sample)
    return tmp_path / "log2sim"


@pytest.fixture
def fresh_environment(tmp_path: Path) -> dict[str, str]:
    """The variables of a new user's shell, and what pip needs to reach its index; skips where it does not reach it."""
    kept = re.compile(r"PIP_\w+|SSL_CERT_\w+|REQUESTS_CA_BUNDLE|(https?|no)_proxy", re.IGNORECASE)
    variables = {name: value for name, value in os.environ.items() if kept.fullmatch(name)}
    home = tmp_path / "home"
    home.mkdir()
    variables |= {"HOME": str(home), "PATH": f"{sys.base_prefix}/bin:/usr/local/bin:/usr/bin:/bin", "LANG": "C.UTF-8"}
    # Python compiles what is imported, which is a small part of what is installed; other tests run on the other cores.
    variables |= {"PIP_COMPILE": "0", "OMP_NUM_THREADS": "1"}
    settings = Path.home() / ".config/pip/pip.conf"
    if settings.is_file():
        variables.setdefault("PIP_CONFIG_FILE", str(settings))
    probe = ["python3", "-m", "pip", "download", "-q", "--no-deps", "--dest", str(tmp_path / "probe"), "typer"]
    reached = subprocess.run(probe, env=variables, capture_output=True, text=True, check=False)
    if reached.returncode != 0:
        pytest.skip(f"pip does not reach its index: {reached.stderr.strip()[-200:]}")
    return variables


@pytest.mark.slow
def test_every_line_of_the_readme_runs_for_a_new_user(fresh_checkout: Path, fresh_environment: dict[str, str]) -> None:
    """README.md in a shell, and then the cookbook in one process of the environment that README.md made."""
    python = fresh_checkout / ".venv/bin/python"
    inside = {**fresh_environment, "PATH": f"{python.parent}:{fresh_environment['PATH']}"}
    pages = [block for page in PAGES.values() for block in runnable(page)]
    for command, variables, given in (
        (["bash", "--norc", "-c", script_of(FRONT)], fresh_environment, ""),
        ([python, "tests/run_blocks.py"], inside, json.dumps(pages)),
    ):
        ran = subprocess.run(
            command, cwd=fresh_checkout, env=variables, input=given, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr[-3000:]
    script = script_of(README)
    promised = set(re.findall(r"--(?:out|report) (\S+)", script)) | set(re.findall(r"""\.save\("([^"]+)"\)""", script))
    missing = sorted(name for name in promised if not (fresh_checkout / name).exists())
    assert promised, "the README writes no files"
    assert not missing


def test_the_settings_of_ros_topics_are_valid(tmp_path: Path) -> None:
    (example,) = re.findall(r"```toml\n(reference_camera.*?)```", README, re.DOTALL)
    (tmp_path / "topics.toml").write_text(example, encoding="utf-8")
    settings, _ = read_settings([tmp_path / "topics.toml"])
    assert settings.ego.base_frame == "base_link"
    assert settings.lidars["top"].time_unit == "ns"
