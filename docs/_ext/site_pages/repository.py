"""Pages from files at the root of the repository, and links that lead out of docs."""

from __future__ import annotations

import os
import re
from pathlib import Path

import yaml

from site_pages.markdown import REPOSITORY_URL

REPOSITORY = Path(__file__).resolve().parents[3]
# The home page includes the first.
FILES = {"_readme.md": "README.md", "changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}


def pages() -> dict[str, str]:
    """The text of every page by its path in docs."""
    texts = {page: (REPOSITORY / name).read_text(encoding="utf-8") for page, name in FILES.items()}
    return {**{page: _seen_from_docs(text) for page, text in texts.items()}, "citation.md": citation()}


def _seen_from_docs(text: str) -> str:
    """Relative links of a file at the root as those of a page in docs."""
    text = re.sub(r"\]\(docs/", "](", text)
    return re.sub(r"\[([^\]]*)\]\(((?!\w+:|#)[A-Z][\w.]*(?:#[\w-]+)?)\)", _own_page, text)


def _own_page(match: re.Match[str]) -> str:
    path, _, anchor = match[2].partition("#")
    page = next((page for page, name in FILES.items() if name == path), None)
    return f"[{match[1]}]({page}{'#' + anchor if anchor else ''})" if page else _outside(match[1], path, anchor)


def _outside(text: str, path: str, anchor: str) -> str:
    """A link to a file of the repository; its text alone where the repository has no address."""
    return f"[{text}]({REPOSITORY_URL}{path}{'#' + anchor if anchor else ''})" if REPOSITORY_URL else text


def outside_links(text: str, page: str) -> str:
    """Links of a page in docs to folders, and to files outside of docs, as links to the repository."""
    folder = (REPOSITORY / "docs" / page).parent

    def absolute(match: re.Match[str]) -> str:
        path, _, anchor = match[2].partition("#")
        target = (folder / path).resolve()
        inside = REPOSITORY / "docs" in target.parents and not target.is_dir()
        if inside or REPOSITORY not in target.parents:
            return match[0]
        name = target.relative_to(REPOSITORY).as_posix()
        own = {name: page for page, name in FILES.items()}
        if name in own:
            page_path = os.path.relpath(REPOSITORY / "docs" / own[name], folder)
            return f"[{match[1]}]({page_path}{'#' + anchor if anchor else ''})"
        return _outside(match[1], name, anchor)

    return re.sub(r"\[([^\]]*)\]\(((?!\w+:|#)[^)\s]+)\)", absolute, text)


def citation() -> str:
    """How to cite the software and what it builds on, from CITATION.cff."""
    cff = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    works = [cff, *cff["references"]]
    lines = [f"- {_people(work)}. {work['title']}{_where(work)}." for work in works]
    return (
        f"# Citation\n\n{cff['message']}\n\n"
        + "\n".join(lines)
        + "\n\n```bibtex\n"
        + "\n".join(map(_bibtex, works))
        + "```\n"
    )


def _people(work: dict[str, object]) -> str:
    people = work["authors"]
    assert isinstance(people, list)
    return ", ".join(each.get("name") or f"{each['given-names']} {each['family-names']}" for each in people)


def _where(work: dict[str, object]) -> str:
    conference = work.get("conference")
    if isinstance(conference, dict):
        return f". {conference['name']}"
    return f", {work['repository-code']}" if "repository-code" in work else ""


def _bibtex(work: dict[str, object]) -> str:
    conference = work.get("conference")
    people = work["authors"]
    assert isinstance(people, list)
    authors = " and ".join(
        "{" + each["name"] + "}" if "name" in each else f"{each['family-names']}, {each['given-names']}"
        for each in people
    )
    first = people[0].get("family-names", work["title"]).split(" ")[0].lower().strip(":,").replace("-", "_")
    fields = {"title": "{" + str(work["title"]) + "}", "author": authors, "year": work.get("year")}
    if isinstance(conference, dict):
        fields["booktitle"] = conference["name"]
    else:
        fields |= {"url": work.get("repository-code"), "version": work.get("version")}
    body = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items() if value)
    kind = "inproceedings" if isinstance(conference, dict) else "software"
    return f"@{kind}{{{first}{work.get('year', '')},\n{body}}}\n"
