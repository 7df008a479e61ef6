"""The documentation is true: examples run, commands parse, links and names exist."""

from __future__ import annotations

import argparse
import importlib
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from algorithms.commands import COMMANDS
from algorithms.runs.config import find_config, load_experiment, parse_overrides
from tests.helpers.paths import REPOSITORY

# Of `make docs`, from the code and from files at the root; tests/docs tests them.
WRITTEN_PAGES = ("docs/reference/",)
WRITTEN_FROM = {f"docs/{name}": "" for name in ("_readme.md", "citation.md")}
WRITTEN_FROM |= {"docs/changelog.md": "CHANGELOG.md", "docs/contributing.md": "CONTRIBUTING.md"}
FOLDERS = ("environments", "algorithms", "results")
DOCUMENTS = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    *(f"docs/{p.name}" for p in (REPOSITORY / "docs").glob("*.md")),
    *(f"docs/{folder}/{p.name}" for folder in FOLDERS for p in (REPOSITORY / "docs" / folder).glob("*.md")),
]
DOCUMENTS = [name for name in DOCUMENTS if name not in WRITTEN_FROM]
# Records, of which only the links are kept up to date.
LAB = [f"docs/lab/{path.name}" for path in (REPOSITORY / "docs" / "lab").glob("*.md")]
# The changelog names what no longer exists.
WITH_NAMES = [name for name in DOCUMENTS if name != "CHANGELOG.md"]
NOT_RUN = "<!-- not run by the tests: "
LIBRARIES = {"minari", "momaland", "onnxruntime"}  # of extras; examples that import one are skipped without it
SLOW = ("agent.train(",)  # examples that contain it take more than a few seconds


class Block(NamedTuple):
    """A fenced block: its document, first line, language, text, and the last line above that is not empty."""

    document: str
    line: int
    language: str
    text: str
    before: str

    def __str__(self) -> str:
        return f"{self.document}:{self.line}"


def blocks(language: str) -> Iterator[Block]:
    for document in DOCUMENTS:
        lines = (REPOSITORY / document).read_text(encoding="utf-8").splitlines()
        begin = None
        for number, line in enumerate(lines):
            if begin is None and line.startswith("```"):
                begin = number
            elif line == "```" and begin is not None:
                if lines[begin] == f"```{language}":
                    text = "\n".join(lines[begin + 1 : number]) + "\n"
                    before = next((above for above in reversed(lines[:begin]) if above), "")
                    yield Block(document, begin + 2, language, text, before)
                begin = None
        assert begin is None, f"{document}:{begin}: a fence is not closed"


def prose(document: str) -> str:
    """The document without its fenced blocks."""
    return re.sub(
        r"^```.*?^```$", "", (REPOSITORY / document).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )


# ------------------------------------------------------------------------------------------------------------ Python

EXAMPLES = list(blocks("python"))


@pytest.mark.parametrize("block", EXAMPLES, ids=str)
def test_a_python_example_compiles(block: Block) -> None:
    compile(block.text, str(block), "exec")


@pytest.mark.parametrize(
    "block",
    [
        pytest.param(block, id=str(block), marks=[pytest.mark.slow] if any(s in block.text for s in SLOW) else [])
        for block in EXAMPLES
        if not block.before.startswith(NOT_RUN)
    ],
)
@pytest.mark.usefixtures("examples")
def test_a_python_example_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for library in set(re.findall(r"^(?:from|import) (\w+)", block.text, flags=re.MULTILINE)) & LIBRARIES:
        pytest.importorskip(library)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))  # else it is in the user's home, and there once
    namespace: dict[str, Any] = {"__name__": "example"}
    exec(compile(block.text, str(block), "exec"), namespace)
    if "evaluation" in namespace:
        assert namespace["evaluation"].metrics()["success"] > 0.9, "the trained policy should do what the text claims"


def test_the_tutorials_include_the_files_of_their_examples() -> None:
    shown = set()
    for document in DOCUMENTS:
        text = (REPOSITORY / document).read_text(encoding="utf-8")
        names = re.findall(r"^```\{literalinclude\} (\S+)$", text, flags=re.MULTILINE)
        shown |= {((REPOSITORY / document).parent / name).resolve() for name in names}
    examples = REPOSITORY / "docs" / "examples"
    files = ("reinforce", "slope", "plain_ppo", "pettingzoo_ppo", "effort", "two_bicycles", "merge")
    assert {examples / f"{name}.py" for name in files} <= shown
    assert all(path.is_file() for path in shown)


# ------------------------------------------------------------------------------------------------- cells of tutorials

CELLS = list(blocks("{code-cell}"))


def cell_text(block: Block) -> str:
    """A cell without its options."""
    return re.sub(r"\A(:.*\n)+\n*", "", block.text)


def written_files() -> dict[str, str]:
    """The files that cells write, by their names."""
    cells = [cell_text(block).partition("\n") for block in CELLS]
    return {first.removeprefix("%%writefile "): rest for first, _, rest in cells if first.startswith("%%writefile ")}


def test_tutorials_run_in_the_build() -> None:
    documents = {block.document for block in CELLS}
    assert len(documents) >= 6
    for document in documents:
        assert (REPOSITORY / document).read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n"), document


# ---------------------------------------------------------------------------------------------------------- commands

STUBS = """
PATH=
emit() { printf '%s\\0' "$@"; printf '\\n'; }
for name in python pip make wandb sudo git cd source docker mo-deepdrive; do
  eval "$name() { emit $name \\"\\$@\\"; }"
done
"""


def commands() -> Iterator[tuple[Block, list[str]]]:
    """The words of every command in the shell blocks, with loops, braces and patterns expanded by bash itself.

    Nothing is executed: known programs are functions that print their arguments, and any other is an error.
    """
    shell = [block._replace(text=cell_text(block)[1:]) for block in CELLS if cell_text(block).startswith("!")]
    shell = [block._replace(text=block.text.partition(" | ")[0]) for block in shell]
    for block in [*blocks("bash"), *shell]:
        run = subprocess.run(
            ["bash", "--norc", "-eu", "-c", STUBS + block.text],
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, f"{block}: {run.stderr}"
        for line in run.stdout.splitlines():
            yield block, line.rstrip("\0").split("\0")


COMMAND_LINES = [(str(block), words) for block, words in commands()]


def of_program(program: str) -> list[tuple[str, list[str]]]:
    return [(where, words[1:]) for where, words in COMMAND_LINES if words[0] == program]


class Parsed(BaseException):
    """The command line of a script has been parsed."""

    def __init__(self, options: argparse.Namespace, others: list[str]):
        super().__init__()
        self.options = options
        self.others = others


def parse(words: list[str], monkeypatch: pytest.MonkeyPatch) -> Parsed:
    """Start the script or command ``words[0]`` as a program and stop it when it has parsed its arguments."""
    parse_known = argparse.ArgumentParser.parse_known_args

    def stop(parser: argparse.ArgumentParser, *arguments: Any) -> Any:
        raise Parsed(*parse_known(parser, *arguments))

    def stop_if_all_known(parser: argparse.ArgumentParser, *arguments: Any) -> Any:
        options, others = parse_known(parser, *arguments)
        if others:
            parser.error(f"unrecognized arguments: {' '.join(others)}")
        raise Parsed(options, [])

    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", stop)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop_if_all_known)
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(sys, "path", [str(REPOSITORY / "scripts"), *sys.path])
    if words[0] in COMMANDS:
        start = partial(importlib.import_module(f"algorithms.commands.{words[0]}").main, words[1:])
    else:
        start = partial(runpy.run_path, str(REPOSITORY / words[0]), run_name="__main__")
    with pytest.raises(Parsed) as caught:
        start()
    return caught.value


@pytest.mark.usefixtures("examples")
@pytest.mark.parametrize(
    "words", [words for program in ("python", "mo-deepdrive") for _, words in of_program(program)], ids=" ".join
)
def test_a_command_is_understood_by_its_program(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if words[:2] == ["-m", "venv"] or words == ["--help"]:
        return
    assert words[0] in COMMANDS or (REPOSITORY / words[0]).is_file()
    if words[0].startswith("docs/examples/"):
        assert words[1:] == [], "examples take no arguments"
        return
    assert words[0] in COMMANDS or re.fullmatch(r"scripts/(bounds/)?\w+\.py", words[0])
    parsed = parse(words, monkeypatch)
    config = getattr(parsed.options, "config", None)
    keys = [key for key, _ in parse_overrides(parsed.others)]
    assert words[0] in ("scripts/train.py", "train", "peers", "suite") or keys == []
    assert all("." in key for key in keys)
    if words[:2] == ["suite", "run"]:
        return  # whose learners may be the reader's own
    if config is None:
        longer = ["training.total_timesteps"] if getattr(parsed.options, "resume", None) else []
        assert keys in ([], longer)
        return
    examples = REPOSITORY / "docs" / "examples"  # where the pages on own code put their files
    elsewhere = examples if (examples / config).is_file() else tmp_path
    for name, text in written_files().items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(REPOSITORY if words[0].startswith("scripts/") else elsewhere)
    assert find_config(config).is_file()
    if words[0] in ("scripts/train.py", "train"):
        load_experiment(config, parsed.others)


@pytest.mark.parametrize(("where", "words"), of_program("pip"), ids=str)
def test_what_is_installed_exists(where: str, words: list[str]) -> None:
    assert words[0] == "install"
    project = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    known = re.findall(
        r"^(\w+) = \[", project.split("[project.optional-dependencies]")[1].split("[tool.")[0], flags=re.MULTILINE
    )
    for option, value in pairwise(words):
        if option == "--constraint":
            assert (REPOSITORY / value).is_file(), where
    for extras in re.findall(r"\.\[([\w,]+)\]", " ".join(words)):
        assert set(extras.split(",")) <= set(known), where


def test_the_versions_of_other_libraries_are_those_that_are_tested() -> None:
    files = ("constraints-integrations.txt", "constraints-peers.txt", "constraints.txt")
    pins = "".join((REPOSITORY / name).read_text(encoding="utf-8") for name in files).lower().replace("_", "-")
    page = (REPOSITORY / "docs" / "use_with.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\| \[([\w -]+)\]\(#\S+\) \| ([\d.]+) \|", page, flags=re.MULTILINE)
    assert len(shown) == 12
    packages = {"rllib": "ray", "onnx runtime": "onnxruntime"}
    for library, version in shown:
        assert f"\n{packages.get(library.lower(), library.lower())}=={version}\n" in f"\n{pins}", library


def test_targets_of_make_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z][a-z-]*):", makefile, flags=re.MULTILINE))
    named = {word for _, words in of_program("make") for word in words}
    for document in DOCUMENTS:
        named |= set(re.findall(r"`make ([a-z-]+)`", prose(document)))
    assert len(named) >= 5
    assert named <= targets


def test_sweeps_of_weights_and_biases_exist() -> None:
    sweeps = [words[1] for _, words in of_program("wandb") if words[0] == "sweep"]
    assert sweeps
    assert all((REPOSITORY / name).is_file() for name in sweeps)


@pytest.mark.parametrize("block", list(blocks("yaml")), ids=str)
def test_a_yaml_example_is_a_mapping(block: Block) -> None:
    assert isinstance(yaml.safe_load(block.text), dict)


# --------------------------------------------------------------------------------------------------- links and names


def anchors(path: Path) -> set[str]:
    """Names of the headings of a document, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("document", [*DOCUMENTS, *LAB])
def test_relative_links_and_images_lead_somewhere(document: str) -> None:
    path = REPOSITORY / document
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, anchor = link.partition("#")
        found = (path.parent / target).resolve() if target else path
        name = str(found).removeprefix(f"{REPOSITORY}/")
        if name.startswith(WRITTEN_PAGES):
            continue
        found = REPOSITORY / WRITTEN_FROM.get(name, name)
        assert found.exists(), f"{document} links to {link}"
        assert REPOSITORY in found.parents, f"{document} links to {link}"
        if anchor:
            assert anchor in anchors(found), f"{document} links to {link}"


def tracked() -> list[str]:
    """The files of the repository; what is generated lies elsewhere."""
    run = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    if run.returncode == 0:
        return run.stdout.splitlines()
    return [str(path.relative_to(REPOSITORY)) for path in REPOSITORY.rglob("*") if path.is_file()]


FILES = tracked()
CODE = ("mo_deepdrive/", "algorithms/", "configs/", "scripts/", "tests/", "docs/")


def quoted(document: str) -> list[str]:
    return re.findall(r"(?<!`)`([^`\n]+)`(?!`)", prose(document))


@pytest.mark.parametrize("document", WITH_NAMES)
def test_paths_in_backticks_exist(document: str) -> None:
    for name in quoted(document):
        if re.search(r"[A-Z]{3,}", name):  # a placeholder, such as RUN
            continue
        if name.startswith(CODE) and " " not in name:
            path = REPOSITORY / name
            assert path.exists() or any(fnmatch(file, name) for file in FILES), f"{document} names {name}"
        elif re.fullmatch(r"[\w/]+\.(py|yaml)", name):
            assert any(f"/{file}".endswith(f"/{name}") for file in FILES), f"{document} names {name}"


def resolve(name: str) -> None:
    """Import the module, class, function or attribute of a dotted name.

    Raises:
        ImportError, AttributeError: if there is none.
    """
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith(parts[0]):
                raise
            continue
        for part in parts[length:]:
            found = getattr(found, part)
        return
    raise ImportError(name)


@pytest.mark.parametrize("document", WITH_NAMES)
def test_modules_and_their_members_in_backticks_exist(document: str) -> None:
    for text in quoted(document):
        for name in re.findall(r"(?<![\w./])((?:mo_deepdrive|algorithms)(?:\.\w+)+)", text):
            if name.startswith("mo_deepdrive.envs.rllib"):  # needs Ray
                source = (REPOSITORY / "mo_deepdrive" / "envs" / "rllib.py").read_text(encoding="utf-8")
                assert f"\nclass {name.rpartition('.')[2]}(" in source or name.endswith(".rllib")
            else:
                resolve(name)


@pytest.mark.parametrize("document", WITH_NAMES)
@pytest.mark.usefixtures("examples")
def test_ids_of_environments_exist(document: str) -> None:
    import gymnasium

    import mo_deepdrive  # noqa: F401  (registers them)

    for module in ("two_bicycles", "merge"):
        importlib.import_module(module)

    text = (REPOSITORY / document).read_text(encoding="utf-8")
    for name in set(re.findall(r"mo-deepdrive-[a-z-]+-v\d+", text)):
        assert name in gymnasium.registry, f"{document} names {name}"


def test_the_readme_is_short() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    shown = re.sub("<!--.*?-->\n\n|^Results of commits? .*?\n\n?", "", text, flags=re.DOTALL | re.MULTILINE)
    assert len(shown.splitlines()) <= 95


def commands_in_text(text: str) -> set[str]:
    """Names of commands after ``mo-deepdrive``, in prose and messages."""
    return set(re.findall(r"(?<![\w'\"/-])mo-deepdrive ([a-z]+)\b", text))


def test_commands_named_in_prose_and_in_messages_exist() -> None:
    found = set().union(*(commands_in_text("\n".join(quoted(document))) for document in WITH_NAMES))
    sources = [path for folder in ("algorithms", "mo_deepdrive") for path in (REPOSITORY / folder).rglob("*.py")]
    found |= set().union(*(commands_in_text(path.read_text(encoding="utf-8")) for path in sources))
    assert len(found) >= 8
    assert found <= {*COMMANDS}
    for name in COMMANDS:
        assert (REPOSITORY / "algorithms" / "commands" / f"{name}.py").is_file()
