"""Find names and English that make code hard to read: `python scripts/plain.py [FILE ...]`, exit code 1 if any.

It reads docstrings, comments and texts of Python files, prose and table cells of Markdown pages, and the Markdown cells
of notebooks: of the named files, or of all files in git without the tests. Code and texts in backticks are left out.
CONTRIBUTING.md says what to write instead; a sentence that a rule meets is written again, the word is not replaced.
This file is left out: it lists them. Of Python files, tests as well, it reads the names of variables and functions.
"""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_WORDS = 40
START = r"(?:^|(?<=[.!?:;] )|(?<=\n\n))"

RULES = {
    "so many: name the number": r"\bso many\b",
    "is none of: is not a": r"\b(?:is|are|be) none of\b",
    "that of, those of: repeat the noun": rf"{START}(?i:that|those) of\b|\bas (?:that|those) of\b",
    "None where: None if, None without": r"\b(?:None|NaN) where\b",
    "where it, there, no: if": r"\bwhere (?:it|there|no|none|not)\b(?! are on\b| (?:is|was|lies)(?:[.,;:)\n]|$))",
    "less: minus": r"\b(?:1|one) less (?:the|its|what)\b",
    "anew: again": r"\banew\b",
    "alike: the same, similar": r"\balike\b",
    "of one's own: custom": r"\bof (?:one's|your) own\b",
}
"""Habits, with what to write, and their patterns."""

INDENTED = re.compile(r"(?<=\n)\n(?: {4}.*(?:\n|$))+")
"""A paragraph of a module's docstring in which every line is indented: commands or a table."""

VAGUE = {"each", "own", "known", "seen", "named", "shown", "kept"}
"""Names of variables that do not say what a variable holds."""

VAGUE_NAME, VAGUE_FUNCTION = "a variable's name says what it holds", "a function's name says what it does"
MOST_LETTERS = 80
LONG_NAME = f"a test's name has at most {MOST_LETTERS} characters: one behaviour"

BEGINS = re.compile(r"(?:What|Of|Whether|Which|Those|That)\b")
BEGIN, LONG = "a docstring begins with What, Of, Whether, Which, Those, That", f"more than {MOST_WORDS} words"


@dataclass(frozen=True, order=True)
class Offence:
    """A sentence that a rule meets."""

    file: str
    line: int
    rule: str
    text: str


@dataclass(frozen=True)
class Text:
    """A text of a file, with the line on which it begins."""

    line: int
    content: str
    docstring: bool = False


def python_texts(source: str) -> Iterator[Text]:
    """Yield docstrings, attribute docstrings, other texts with a space, and comments."""
    tree, docstrings = ast.parse(source), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docstrings.add(id(node.value))
            content = node.value.value
            if node is tree.body[0]:
                content = INDENTED.sub(lambda found: "\n" * found.group().count("\n"), content)
            yield Text(node.lineno, content, docstring=True)
    for node in ast.walk(tree):
        text = node.value if isinstance(node, ast.Constant) and id(node) not in docstrings else None
        if isinstance(text, str) and " " in text and not is_code(text):
            yield Text(node.lineno, text)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield Text(token.start[0], token.string.lstrip("# "))


def names(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield the line of a name that a rule meets, the rule, and the name; fields of a class are not variables."""
    tree = ast.parse(source)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    fields = {
        id(statement.target) for node in classes for statement in node.body if isinstance(statement, ast.AnnAssign)
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)
            and id(node) not in fields
            and node.id in VAGUE
        ):
            yield node.lineno, VAGUE_NAME, node.id
        elif isinstance(node, ast.arg) and node.arg in VAGUE:
            yield node.lineno, VAGUE_NAME, node.arg
        elif isinstance(node, ast.FunctionDef):
            if node.name in VAGUE | {"of"}:
                yield node.lineno, VAGUE_FUNCTION, node.name
            if node.name.startswith("test_") and len(node.name) > MOST_LETTERS:
                yield node.lineno, LONG_NAME, node.name


def is_code(text: str) -> bool:
    """Return whether a text of several lines is a Python program, which a test or a script writes to a file."""
    try:
        return "\n" in text and bool(ast.parse(text).body)
    except (SyntaxError, ValueError):
        return False


def page_texts(source: str) -> Iterator[Text]:
    """Yield the paragraphs, items and table cells of a page, without code."""
    begun, lines, code = 1, [], False
    for number, line in enumerate([*source.splitlines(), ""], 1):
        bare = line.strip()
        if bare.startswith("```"):
            code = not code
        prose = bool(bare) and not code and not line.startswith("    ") and bare[0] not in "|#`<!["
        new = bool(re.match(r"[-*] |\d+\. ", bare))
        if lines and (new or not prose):
            yield Text(begun, "\n".join(lines))
            lines = []
        if prose:
            begun = begun if lines else number
            lines.append(line)
        elif not code and bare.startswith("|"):
            yield from (Text(number, cell.strip()) for cell in re.split(r"(?<!\\)\|", bare))


def notebook_texts(source: str) -> Iterator[Text]:
    """Yield what a page yields, of each Markdown cell of a notebook with one line a source line."""
    position = 0
    for cell in json.loads(source)["cells"]:
        lines = "".join(cell["source"]).splitlines(keepends=True)
        if cell["cell_type"] == "markdown" and lines:
            position = source.index(json.dumps(lines[0], ensure_ascii=False), position)
            above = source.count("\n", 0, position)
            yield from (Text(above + text.line, text.content) for text in page_texts("".join(lines)))
            position += 1


TEXTS = {".py": python_texts, ".md": page_texts, ".ipynb": notebook_texts}
"""What is read of a file, by its suffix."""


def findings(file: str, source: str) -> Iterator[Offence]:
    """Yield what the rules meet in a file; of a test its names alone."""
    if file.endswith(".py"):
        yield from (Offence(file, *name) for name in names(source))
    if file.startswith("tests/"):
        return
    for text in TEXTS.get(Path(file).suffix, page_texts)(source):
        content = re.sub(r"(?m)`[^`]*`|^ *(?:>>>|\.\.\.).*", "X", text.content)
        if text.docstring and BEGINS.match(content):
            yield Offence(file, text.line, BEGIN, content.split("\n")[0][:80])
        for rule, pattern in RULES.items():
            for found in re.finditer(pattern, content):
                around = content[max(0, found.start() - 40) : found.end() + 30].replace("\n", " ")
                yield Offence(file, text.line + content.count("\n", 0, found.start()), rule, around)
        for sentence in re.split(r"(?<=[.!?:;])\s+|\n\s*\n|\n\s*[-*] |\n +\w+: ", content):
            if len(sentence.split()) > MOST_WORDS:
                line = text.line + content.count("\n", 0, content.index(sentence))
                yield Offence(file, line, LONG, " ".join(sentence.split()[:10]))


def files() -> list[str]:
    """Return the Python files, pages and notebooks of the repository, without generated pages and links."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    return [
        name
        for name in listed
        if name.endswith(tuple(TEXTS))
        and not name.startswith(("docs/reference/", "src/"))
        and name != "scripts/plain.py"
        and not (ROOT / name).is_symlink()
    ]


def main(given: list[str]) -> int:
    """Print findings by file, and their number by rule; return the exit code."""
    found = sorted(
        {finding for name in given or files() for finding in findings(name, (ROOT / name).read_text(encoding="utf-8"))}
    )
    for finding in found:
        print(f"{finding.file}:{finding.line}: {finding.rule}: ...{finding.text}...")
    for rule, count in Counter(finding.rule for finding in found).most_common():
        print(f"{count:6}  {rule}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
