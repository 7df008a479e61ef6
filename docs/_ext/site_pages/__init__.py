"""A Sphinx extension that writes the pages that code knows, before Sphinx reads the others.

The API reference, the changelog, the contributing guide and the citation are written into ``docs``, where git ignores
them. A page is written only if its text has changed, so that a second build is short.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[2]
FOLDER = "reference"  # which holds nothing but written pages


def all_pages() -> dict[str, str]:
    """The text of every page that is written, by its path in docs."""
    from site_pages import reference, repository

    return {**reference.pages(), **repository.pages()}


def write_pages() -> None:
    """Write the pages, and remove those of what no longer exists."""
    found = all_pages()
    for name, text in found.items():
        path = DOCS / name
        path.parent.mkdir(exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for path in (DOCS / FOLDER).glob("*.md"):
        if path.relative_to(DOCS).as_posix() not in found:
            path.unlink()


def _on_start(app: Any) -> None:
    from algorithms.reporting.page.page import write_site
    from site_pages.explorer_examples import write_examples

    del app
    write_pages()
    write_site(DOCS / "_static" / "drive")
    write_examples(DOCS / "_static")


def _on_source(app: Any, page: str, content: list[str]) -> None:
    from site_pages.repository import outside_links

    if Path(app.env.doc2path(page)).suffix == ".md":
        content[0] = outside_links(content[0], f"{page}.md")


def _check_names(app: Any, env: Any) -> None:
    """Warn of public classes and functions that the reference lacks."""
    del app
    from sphinx.util import logging

    from site_pages.reference import constants, modules, public_names

    documented = env.domains.python_domain.objects
    for module in modules():
        for name in [module, *public_names(module), *(f"{module}.{name}" for name in constants(module))]:
            if name not in documented:
                logging.getLogger(__name__).warning("%s is not documented", name, type="site_pages")


def _find_short_name(app: Any, env: Any, node: Any, content: Any) -> Any:
    """Resolve a name without its module (``Agent.act``) or of its package (``algorithms.Agent``), if only one fits."""
    from sphinx.util.nodes import make_refnode

    if node.get("refdomain") != "py":
        return None
    domain = env.domains.python_domain
    target = node["reftarget"]
    package, _, last = target.rpartition(".")
    kinds = domain.objtypes_for_role(node["reftype"]) or ()
    names = [name for name, found_at in domain.objects.items() if not kinds or found_at.objtype in kinds]
    found = [name for name in names if name.endswith(f".{target}")] or [
        name for name in names if name.startswith(f"{package}.") and name.endswith(f".{last}")
    ]
    if len(found) != 1:
        return None
    found_at = domain.objects[found[0]]
    return make_refnode(app.builder, node["refdoc"], found_at.docname, found_at.node_id, content, found[0])


def _check_links(app: Any, error: Exception | None) -> None:
    """Stop a build of HTML whose pages have links to files or anchors that do not exist.

    Raises:
        ExtensionError: with every such link.
    """
    from sphinx.errors import ExtensionError

    from site_pages.local_links import broken_links

    if error is None and app.builder.format == "html":
        broken = broken_links(Path(app.outdir))
        if broken:
            raise ExtensionError("local links that lead nowhere:\n" + "\n".join(broken))


def setup(app: Any) -> dict[str, Any]:
    """Connect the extension."""
    from site_pages.docstrings import prepare

    app.setup_extension("sphinx.ext.autodoc")
    app.connect("builder-inited", _on_start, priority=100)
    app.connect("source-read", _on_source, priority=100)
    app.connect("autodoc-process-docstring", prepare, priority=100)
    app.connect("missing-reference", _find_short_name)
    app.connect("env-check-consistency", _check_names)
    app.connect("build-finished", _check_links, priority=900)  # after those that still copy files
    return {"parallel_read_safe": True, "parallel_write_safe": True}
