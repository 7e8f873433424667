"""Generate the pages of the documentation site that come from the code.

MkDocs loads this file as a hook (`mkdocs.yml`) when `make docs` builds the site. Nothing that it generates is stored in
the repository, so a page cannot become outdated. Without MkDocs, `generated_pages` returns the same pages to the tests.
"""

from __future__ import annotations

import ast
import importlib
import posixpath
import re
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # docs is no package of the wheel

PACKAGES = ("hbr", "rig", "calibration", "sim")
REPOSITORY_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "explanation/security.md",
    "examples/README.md": "how-to/examples.md",
    "firmware/README.md": "how-to/rig-head.md",
    "firmware/PROTOCOL.md": "reference/head-protocol.md",
}
"""Pages that stand in the repository outside `docs`, and where the site shows them: as a page of their own, or at the
beginning of a page in `docs`."""

CODES = {
    "RotationReason": "reasons-of-rotations",
    "StopReason": "reasons-of-ends",
    "NoteCode": "codes-of-notes",
}
"""Headings of `docs/reference/events.md` over the meanings of codes, by the type of the codes."""

NOTE = "*This page is generated from the code.*\n\n"


# Pages


def generated_pages() -> dict[str, str]:
    """Return the Markdown of every generated page by its path below `docs`."""
    return {
        "reference/cli.md": cli_page(),
        "reference/configuration.md": configuration_page(),
        "reference/errors.md": errors_page(),
        "reference/exit-codes.md": exit_codes_page(),
        "reference/api/index.md": public_names_page(),
        **dict(api_pages()),
        **{
            site: (ROOT / page).read_text(encoding="utf-8")
            for page, site in REPOSITORY_PAGES.items()
            if not (ROOT / "docs" / site).exists()
        },
    }


def cli_page() -> str:
    """Return a page with every command of `rig`, its arguments and its options."""
    import typer.main

    from rig.cli.main import app

    group = typer.main.get_command(app)
    shared = {name for option in group.params for name in option.opts}
    lines = [f"# Commands\n\n{NOTE}{group.help}\n", "## Common options\n", "Every command accepts these.\n"]
    lines += [*_parameter_table(group.params), ""]
    for words, command in _commands("rig", group):
        lines += [f"## {words}\n", _unwrapped(command.help or ""), ""]
        own = [p for p in command.params if not shared.intersection(p.opts) and not getattr(p, "hidden", False)]
        if own:
            lines += [*_parameter_table(own), ""]
    return "\n".join(lines)


def _commands(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    for name, command in sorted(group.commands.items()):
        if command.hidden:
            continue
        if hasattr(command, "commands"):
            yield from _commands(f"{prefix} {name}", command)
        else:
            yield f"{prefix} {name}", command


def _parameter_table(parameters: list[Any]) -> list[str]:
    rows = []
    for parameter in parameters:
        if parameter.param_type_name == "argument":
            name = f"`{parameter.metavar or parameter.name.upper()}`" + ("" if parameter.required else " (optional)")
        else:
            name = ", ".join(f"`{option}`" for option in [*parameter.opts, *parameter.secondary_opts])
            if parameter.metavar and not parameter.is_flag:
                name += f" `{parameter.metavar}`"
        given = isinstance(parameter.default, str | int | float | Path) and parameter.default not in (False, "")
        default = f"`{parameter.default}`" if given else ""
        rows.append(f"| {name} | {_cell(getattr(parameter, 'help', '') or '')} | {default} |")
    return ["| name | meaning | default |", "|---|---|---|", *rows]


def configuration_page() -> str:
    """Return a page with every key of `rig.toml`."""
    from rig.config import RigConfig, Section
    from rig.config.wording import key_info
    from sim.bench import SimOptions
    from sim.photographs import PhotographOptions

    lines = [
        f"# Configuration keys\n\n{NOTE}`rig.toml` holds these keys. `rig config show` prints the values in use and "
        "where each comes from; `rig config set KEY VALUE` changes one; `--set KEY=VALUE` overrides one for a single "
        "command.\n"
    ]
    sections = {name: field.annotation for name, field in RigConfig.model_fields.items()}
    sections = {name: kind for name, kind in sections.items() if isinstance(kind, type) and issubclass(kind, Section)}
    plain = [info for info in key_info(RigConfig) if len(info.key) == 1 and info.name != "bench"]
    lines += ["## Top level\n", *_key_table(plain)]
    for name, section in sections.items():
        lines += [f"\n## [{name}]\n", _unwrapped(section.__doc__ or ""), "", *_key_table(key_info(section))]
    lines += ["\n## [bench.sim]\n", "The simulated bench.\n", *_key_table(key_info(SimOptions))]
    own = [info for info in key_info(PhotographOptions) if info.name not in SimOptions.model_fields]
    lines += ["\n## [bench.photographs]\n", "The bench of photographs. It has the keys of [bench.sim], too.\n"]
    lines += [*_key_table(own), ""]
    return "\n".join(lines)


def _key_table(keys: Iterable[Any]) -> list[str]:
    from rig.config.toml_file import stated

    lines = ["| key | values | default | meaning |", "|---|---|---|---|"]
    for info in keys:
        default = "–" if info.default is None else f"`{stated(info.key, info.default)}`"
        cells = f"`{info.name}`", info.values, default, info.description
        lines.append(f"| {' | '.join(map(_cell, cells))} |")
    return lines


def errors_page() -> str:
    """Return a page with every error of the registry."""
    from rig.core.errors import error_kinds

    lines = [
        f"# Error codes\n\n{NOTE}Every error has a code, says what happened, shows the evidence, and gives the next "
        "step. The hundreds of the code are the [exit code](exit-codes.md) of the command.\n",
        "| code | title | meaning | Python class |",
        "|---|---|---|---|",
    ]
    for kind in error_kinds():
        summary = (kind.__doc__ or "").partition("\n\n")[0]
        anchor = f'<a id="{kind.code}"></a>{kind.code}'
        lines.append(f"| {anchor} | {kind.title} | {_cell(summary)} | `{kind.__name__}` |")
    return "\n".join([*lines, "", *_next_steps()])


def _next_steps() -> list[str]:
    """Return a section with the actions of next steps."""
    from rig.core.next_steps import Do
    from rig.web.pages import JOB_OF_STEP, PAGE_OF_STEP

    lines = [
        "## Next steps\n",
        "Each presenter words the next step of an error in its own way. In JSON, `steps` is a list, in order: a text "
        "is a sentence for the operator; an object is an action of the rig with `action`, `parameters` and `command` "
        "(null if no command does it). `next_step` is the same in words, as a terminal shows it.\n",
        "| action | meaning | command | on a page |",
        "|---|---|---|---|",
    ]
    for action in Do:
        link = f"a link to `{PAGE_OF_STEP[action]}`" if action in PAGE_OF_STEP else ""
        page = "a button" if action in JOB_OF_STEP else link
        command = f"`{action().command}`" if action.command else ""
        lines.append(f"| `{action}` | {action().text} | {command} | {page} |")
    return [*lines, ""]


def exit_codes_page() -> str:
    """Return a page with the exit codes of `rig`."""
    from rig.cli.ui.exit_codes import EXIT_CODES

    rows = [f"| {code} | {meaning} |" for code, meaning in EXIT_CODES.items()]
    more = "\nCodes 2 to 9 are the hundreds of an [error code](errors.md).\n"
    return "\n".join([f"# Exit codes\n\n{NOTE}| code | meaning |", "|---|---|", *rows, more])


def events_page() -> str:
    """Return `docs/reference/events.md` with a table of each event and of each of its parts, from their JSON schema."""
    from pydantic import TypeAdapter

    from rig.events.events import DESCRIBED, JsonEvent

    schema = TypeAdapter(JsonEvent, config=DESCRIBED).json_schema(mode="serialization")
    objects = {name: found for name, found in schema["$defs"].items() if "properties" in found}
    events = [objects.pop(_definition(one["$ref"])) for one in schema["oneOf"]]
    kinds = {one["properties"]["event"]["const"]: one for one in events}
    parts = {_snake_case(name): found for name, found in objects.items()}
    text = (ROOT / "docs" / "reference" / "events.md").read_text(encoding="utf-8")
    for found, level, before in ((kinds, "##", "## Parts\n"), (parts, "###", "## Codes\n")):
        headings = {f"{level} {name}": one for name, one in found.items()}
        tables = [
            _field_table(heading, one, schema["$defs"])
            for heading, one in headings.items()
            if f"{heading}\n" not in text
        ]
        text = text.replace(before, "\n".join([*tables, before]))
    return text


def _field_table(heading: str, described: dict[str, Any], definitions: dict[str, Any]) -> str:
    lines = [f"{heading}\n", _cell(" ".join(described["description"].split())), ""]
    lines += ["| field | type | meaning |", "|---|---|---|"]
    for name, field in described["properties"].items():
        if name == "event":  # the heading names it
            continue
        meaning = _cell(field["description"])
        if codes := CODES.get(_definition(field.get("$ref", ""))):
            meaning = f"[{meaning.removesuffix('.')}](#{codes})."
        lines.append(f"| `{name}` | {_json_type(field, definitions)} | {meaning} |")
    return "\n".join([*lines, ""])


def _json_type(field: dict[str, Any], definitions: dict[str, Any]) -> str:
    if "$ref" in field:
        name = _definition(field["$ref"])
        return _snake_case(name) if "properties" in definitions[name] else str(definitions[name]["type"])
    if "anyOf" in field:
        return " or ".join(_json_type(choice, definitions) for choice in field["anyOf"])
    if field["type"] == "array":
        return f"list of {_json_type(field.get('items') or field['prefixItems'][0], definitions)}"
    return str(field["type"])


def _definition(link: str) -> str:
    return link.rpartition("/")[2]


def _snake_case(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def public_names_page() -> str:
    """Return a page with the names that programs import from `hbr` and `rig`."""
    lines = [f"# Python API\n\n{NOTE}These names are the public API. The other pages show what is behind them.\n"]
    for package in ("rig", "hbr"):
        lines += [f"## {package}\n", "| name | what it is or does |", "|---|---|"]
        module = importlib.import_module(package)
        for name in module.__all__:
            thing = getattr(module, name)
            home = getattr(thing, "__module__", None)
            summary = _cell((thing.__doc__ or "").strip().partition("\n\n")[0]) if home else ""
            linked = f"[`{package}.{name}`][{home}.{name}]" if home in modules() else f"`{package}.{name}`"
            lines.append(f"| {linked} | {summary} |")
        lines.append("")
    return "\n".join(lines)


@cache
def modules() -> tuple[str, ...]:
    """Return the dotted names of all modules that have an API page."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[-1] != "__main__":
                found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return tuple(found)


def api_pages() -> Iterator[tuple[str, str]]:
    """Yield a page for each room: path and Markdown, one section for each module."""
    rooms: dict[str, list[str]] = {}
    for module in modules():
        if module in ("hbr", "rig"):
            continue  # their public names have a page of their own
        room = ".".join(module.split(".")[:2])
        is_room = (ROOT / Path(*room.split("."))).is_dir()
        rooms.setdefault(room if is_room else module.partition(".")[0], []).append(module)
    for room, held in sorted(rooms.items()):
        lines = [f"# {room}\n"]
        for module in held:
            source = ROOT / Path(*module.split("."))
            source = source / "__init__.py" if source.is_dir() else source.with_suffix(".py")
            if _has_definitions(source):
                lines.append(f"::: {module}\n")
            elif summary := ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))):
                lines.append(f"{summary}\n")
        yield f"reference/api/{room}.md", "\n".join(lines)


@cache
def _has_definitions(source: Path) -> bool:
    body = ast.parse(source.read_text(encoding="utf-8")).body
    kinds = (ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign)
    return any(isinstance(node, kinds) for node in body)


def _cell(text: str) -> str:
    return _unwrapped(text).replace("|", "\\|").replace("\n", " ").replace("``", "`")


def _unwrapped(text: str) -> str:
    """Return a docstring as Markdown: paragraphs on one line each, Python prompts and indents as they are."""
    paragraphs = [" ".join(line.strip() for line in part.splitlines()) for part in text.strip().split("\n\n")]
    return "\n\n".join(re.sub(r"^Example: (.*)$", r"Example: `\1`", part) for part in paragraphs)


# Links


def site_path(repository_path: str) -> str | None:
    """Return where the site shows a file of the repository; None if it does not show it as a page."""
    if repository_path in REPOSITORY_PAGES:
        return REPOSITORY_PAGES[repository_path]
    if repository_path.startswith("docs/") and (ROOT / repository_path).is_file():
        return repository_path.removeprefix("docs/")
    return None


def with_site_links(markdown: str, page: str) -> tuple[str, set[str]]:
    """Rewrite the links of a repository page for the site.

    Parameters
    ----------
    markdown
        The text of the page.
    page
        Its path in the repository, such as ``docs/explanation/searching.md``.

    Returns
    -------
    str
        The text with links that work on the site. A link to a folder becomes plain text.
    set of str
        Files of the repository that are linked and are not pages: the site has to copy them to ``files/``.
    """
    copied: set[str] = set()
    home = site_path(page) or page

    def rewritten(match: re.Match[str]) -> str:
        text, target, anchor = match["text"], match["target"], match["anchor"] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        if (ROOT / path).is_dir():
            return text if not text.startswith("!") else match[0]
        shown = site_path(path)
        if shown is None:
            if not (ROOT / path).is_file():
                return match[0]  # generated, or broken: MkDocs reports it
            copied.add(path)
            shown = f"files/{path}"
        link = posixpath.relpath(shown, posixpath.dirname(home) or ".")
        return f"{'!' if match['image'] else ''}[{text}]({link}{anchor})"

    link = r"(?P<image>!)?\[(?P<text>[^\]]*)\]\((?!https?:|#)(?P<target>[^)#\s]+)(?P<anchor>#[^)]*)?\)"
    return re.sub(link, rewritten, markdown), copied


# Hooks of MkDocs


def on_config(config: Any) -> Any:
    """Expand ``folder/*`` in the navigation to the pages of that folder."""
    config.nav = _expanded(config.nav)
    return config


def _expanded(entries: list[Any]) -> list[Any]:
    found: list[Any] = []
    for entry in entries:
        if isinstance(entry, dict):
            found += [{title: _expanded(e) if isinstance(e, list) else e} for title, e in entry.items()]
        elif entry.endswith("/*"):
            folder = entry.removesuffix("*")
            stored = {f"{folder}{path.name}" for path in (ROOT / "docs" / folder).glob("[0-9]*.md")}
            found += sorted(stored | {path for path, _ in api_pages() if path.startswith(folder)})
        else:
            found.append(entry)
    return found


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages, and the files of the repository that pages link to."""
    from mkdocs.structure.files import File

    pages = {v: k for k, v in REPOSITORY_PAGES.items()}
    copied: set[str] = set()
    for path, markdown in generated_pages().items():
        if path in pages:
            markdown, more = with_site_links(markdown, pages[path])
            copied |= more
        files.append(File.generated(config, path, content=markdown))
    for file in list(files.documentation_pages()):
        if file.abs_src_path and not file.generated_by:
            source = Path(file.abs_src_path).read_text(encoding="utf-8")
            copied |= with_site_links(source, f"docs/{file.src_uri}")[1]
    from docs.architecture import picture

    files.append(File.generated(config, "images/architecture.svg", content=picture()))
    for path in sorted(copied):
        files.append(File.generated(config, f"files/{path}", abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_others: Any) -> str:
    """Put what is generated into the pages of `docs`, and rewrite the links that lead out of it."""
    if page.file.generated_by:
        return markdown
    if page.file.src_uri == "reference/events.md":
        markdown = events_page()
    shown = with_site_links(markdown, f"docs/{page.file.src_uri}")[0]
    for source, site in REPOSITORY_PAGES.items():
        if site == page.file.src_uri:
            first = with_site_links((ROOT / source).read_text(encoding="utf-8"), source)[0]
            return first + re.sub(r"^#", "\n##", shown, flags=re.MULTILINE)
    return shown
