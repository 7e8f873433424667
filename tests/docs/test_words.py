"""One term for each concept: no file uses a term that docs/reference/glossary.md replaces, nor translated English."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("hbr", "rig", "sim", "calibration", "examples", "benchmarks", "tests", "docs", "firmware", ".github")
SINGLE_FILES = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "CITATION.cff",
    "Makefile",
    "mkdocs.yml",
    "pyproject.toml",
)
SINGLE_FILES += (".pre-commit-config.yaml", ".ci/run", ".ci/setup", ".ci/install", ".ci/wheel")
SINGLE_FILES += ("firmware/Makefile", "docs/deploy/Dockerfile", "docs/deploy/rig.service", "docs/deploy/rig-pi")
SUFFIXES = {".py", ".md", ".j2", ".toml", ".c", ".h", ".js", ".css", ".sh", ".yml", ".yaml"}

REFUSE = r"refus(?:e|es|ed|al|als|ing)"
# Terms that no file uses, as regular expressions. They match whole words, also within a name (`_` and case separate).
RETIRED = (
    r"strangers?",
    r"(?:least_|min_)?familiar(?:ity)?|unfamiliar",
    r"rehears(?:e|ed|es|al|als|ing)",
    r"sightings?",
    r"front[ _-]?ends?",
    r"mend(?:s|ed|ing)?",
    r"sittings?",
    r"rivals?",
    r"look-?alikes?|resemblances?",
    r"verdicts?",
    r"anyhow",
    r"anew",
    r"somebody|nobody|anybody",
    r"table ?pictures?",
    r"likeness(?:es)?",
    r"believe(?:d|s)?",
    r"next look",
    r"(?:the|its|their|gears'|no|without) play",
    r"judg(?:e|es|ed|ing)",
    r"attendants?",
    r"remed(?:y|ies)",
    r"certainty|sureness",
    # Phrases, in which an ambiguous word is clear.
    REFUSE,
    r"(?:says?|told) so",
    r"for good",
    r"(?:has|have|had) it that|as \w+ has it",
    r"goes on|went on",
    r"gives? up(?! to\b)|gave up",
    r"is told|are told|tells? of",
    r"where there (?:is|are|was) (?:none|no|nothing)|where nothing",
    r"(?:a|each|every|the) turn of|(?:half|whole|full) (?:a )?turns?|turns? of the (?:table|platter|shaft)",
    r"(?:servos?|bytes|noise|answers?) on the line|the bus's line",
)
RETIRED_NAMES = frozenset(
    {
        *("told", "trouble", "turn", "turns", "turned", "turning", "look", "looks", "looked", "shot", "shots"),
        *("refusal", "refused", "rehearse", "stranger", "familiar", "sitting", "verdict", "anew"),
    }
)
"""Words that no function, class, argument, attribute or variable has in its name. In sentences some are correct."""
ALLOWED_NAMES = frozenset(
    {
        "_shot",  # shot noise
        *("SINGLE_TURN_HOMING_COUNTS", "_CLEAR_MULTI_TURN"),  # names of the servo's manual
        "turning_share",  # a field of the events
    }
)
EXCEPTIONS: dict[str, tuple[str, ...]] = {
    "docs/reference/glossary.md": RETIRED,  # it lists them
    "docs/reference/style.md": (r"anew", r"anyhow"),  # examples of what not to write
    "tests/docs/test_words.py": RETIRED,
    "tests/rig/catalog/test_upkeep.py": (r"somebody|nobody|anybody",),  # a user of the operating system
}
"""Files that may use some of these terms."""


def files() -> Iterator[Path]:
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in SUFFIXES and "data" not in path.parts:
                yield path
    yield from (ROOT / name for name in SINGLE_FILES)


def retired_terms() -> list[str]:
    """Return every retired term that is used: file, line and term."""
    patterns = {term: re.compile(rf"\b(?:{term.replace('_', ' ')})\b", re.IGNORECASE) for term in RETIRED}
    any_of_them = re.compile("|".join(pattern.pattern for pattern in patterns.values()))  # in lower case: it is faster
    found = []
    for path in files():
        name = path.relative_to(ROOT).as_posix()
        allowed = EXCEPTIONS.get(name, ())
        if not any_of_them.search(words_of(path)):
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            text = words(line)
            found += [
                f"{name}:{number}: {match[0]}"
                for term, pattern in patterns.items()
                if term not in allowed and (match := pattern.search(text))
            ]
    return found


@cache
def words_of(path: Path) -> str:
    """Return the words of a file in lower case, those of names apart."""
    return words(path.read_text(encoding="utf-8")).lower()


def words(line: str) -> str:
    """Return a line with the words of each name apart: ``minFamiliarity`` and ``min_familiarity`` alike."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", line).replace("_", " ")


def named(content: str) -> Iterator[tuple[str, int]]:
    """Yield each name that a Python file defines, with its line."""
    for node in ast.walk(ast.parse(content)):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, node.lineno


def test_no_name_has_a_retired_word():
    any_of_them = re.compile(rf"\b(?:{'|'.join(RETIRED_NAMES)})\b")
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in files()
        if path.suffix == ".py" and any_of_them.search(words_of(path))
        for name, line in named(path.read_text(encoding="utf-8"))
        if name not in ALLOWED_NAMES
        and not name.startswith("test_")
        and RETIRED_NAMES & set(words(name).lower().split())
    ]
    assert not found, "\n".join([f"{len(found)} names with retired words:", *found])


def test_no_retired_term_is_used():
    found = retired_terms()
    assert not found, "\n".join([f"{len(found)} retired terms; use those of docs/reference/glossary.md:", *found])
