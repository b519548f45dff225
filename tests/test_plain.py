"""The lint of habits of English: what each rule meets, and what it leaves."""

from __future__ import annotations

import json

import plain
import pytest


def rules(file, source):
    return [offence.rule.partition(":")[0] for offence in plain.findings(file, source)]


def notebook(*cells):
    """The text of a notebook: kinds and sources of its cells in turn, as nbformat writes them."""
    made = [
        {"cell_type": kind, "metadata": {}, "source": source.splitlines(keepends=True)}
        for kind, source in zip(cells[::2], cells[1::2], strict=True)
    ]
    return json.dumps({"cells": made, "nbformat": 4}, indent=1)


@pytest.mark.parametrize(
    ("sentence", "rule"),
    [
        ("Drops so many frames.", "so many"),
        ("The index 300 is none of a byte.", "is none of"),
        ("Tables: those of tiles make one.", "that of, those of"),
        ("The pose; None where it is unknown.", "None where"),
        ("All of them where not given.", "where it, there, no"),
        ("It is 1 less the largest score.", "less"),
        ("Labels are drawn anew.", "anew"),
        ("Two frames are alike.", "alike"),
        ("A backend of your own.", "of one's own"),
        ("word " * 41 + ".", f"more than {plain.MOST_WORDS} words"),
    ],
)
def test_a_habit_is_found_in_a_docstring_a_comment_a_message_and_a_page(sentence, rule):
    assert rule in rules("a.py", f'def f():\n    """Return a. {sentence}"""\n')
    assert rule in rules("a.py", f"# {sentence}\n")
    assert rule in rules("a.py", f'raise ValueError("{sentence}")\n')
    assert rule in rules("a.md", f"# Title\n\n{sentence}\n")
    assert rule in rules("a.md", f"| a | {sentence} |\n|---|---|\n| b | fine |\n")
    assert rule in rules("a.ipynb", notebook("markdown", f"# Title\n\n{sentence}"))
    assert rules("a.ipynb", notebook("code", f"# {sentence}")) == []


def test_the_first_word_of_a_docstring_is_looked_at_and_that_of_a_message_is_not():
    assert rules("a.py", '"""Whether it is."""\n') == [plain.BEGIN]
    assert rules("a.py", 'raise ValueError("Which one is it?")\n') == []


@pytest.mark.parametrize(
    "source",
    [
        "    so many lines of code\n",
        "```\nso many\n```\n",
        "```\n| so many |\n```\n",
        "| `so many` |\n",
        "| so \\| many |\n",
        "| so | many |\n",
        "Use `so many`.\n",
    ],
)
def test_code_of_a_page_is_left_and_cells_are_read_one_by_one(source):
    assert rules("a.md", source) == []


@pytest.mark.parametrize(
    "source",
    [
        '"""Print a table:\n\n' + "    name  one column and another\n" * 10 + '\nIt has ten rows.\n"""\n',
        'PROGRAM = """\n' + "first = second + third\n" * 20 + '"""\n',
    ],
)
def test_indented_paragraphs_of_a_module_and_programs_in_texts_are_left(source):
    assert rules("a.py", source) == []


def test_a_text_of_many_lines_that_is_no_program_is_read():
    assert rules("a.py", 'TEXT = """\nA line.\nIt is drawn anew.\n"""\n') == ["anew"]
    assert rules("a.py", 'def f():\n    """Return a.\n\n    It is drawn anew.\n    """\n') == ["anew"]


@pytest.mark.parametrize("sentence", ["It is seen where it was.", "The folder where it lies, and the file."])
def test_a_place_is_no_condition(sentence):
    assert rules("a.md", sentence) == []
    assert rules("a.md", f"| a | {sentence.removesuffix('.')} |\n") == []


def test_the_line_of_a_finding_is_that_of_the_word():
    found = list(plain.findings("a.py", '"""Return a.\n\nDrops so many.\n"""\n'))
    assert [offence.line for offence in found] == [3]
    found = list(plain.findings("a.md", "| a | b |\n|---|---|\n| c | drawn anew |\n"))
    assert [offence.line for offence in found] == [3]


def test_the_line_of_a_finding_in_a_notebook_is_its_line_in_the_file():
    text = notebook("markdown", "# Title\n\nA line.", "code", "1", "markdown", "# Title\n\nIt is\ndrawn anew.")
    (found,) = plain.findings("a.ipynb", text)
    assert "drawn anew" in text.splitlines()[found.line - 1]


def test_plain_sentences_pass(tmp_path, capsys):
    file = tmp_path / "page.md"
    file.write_text("Fuse label maps. The map is where the tables are.\n")
    assert plain.main([str(file)]) == 0
    file.write_text("It is drawn anew.\n")
    assert plain.main([str(file)]) == 1
    assert f"{file}:1: anew" in capsys.readouterr().out


@pytest.mark.parametrize(
    "source",
    [
        "each = 1\n",
        "for own in files: pass\n",
        "with folder as kept: pass\n",
        "f(lambda seen: 1)\n",
        "def f(known): pass\n",
        "rows = [0 for shown in rows]\n",
        "class A:\n    def f(self):\n        named: int = 1\n",
    ],
)
def test_a_variable_whose_name_says_nothing_is_found_in_tests_too(source):
    assert rules("a.py", source) == rules("tests/test_a.py", source) == [plain.VAGUE_NAME]


def test_functions_and_tests_have_names_that_say_what_they_do():
    assert rules("a.py", "class A:\n    def of(self): pass\n") == [plain.VAGUE_FUNCTION]
    assert rules("a.py", f"def test_{'x' * 76}(): pass\n") == [plain.LONG_NAME.partition(":")[0]]
    assert rules("a.py", f"def test_{'x' * 75}(): pass\n") == []


def test_a_field_an_attribute_and_an_argument_of_a_call_may_have_such_a_name():
    """They are named where they are declared, beside what they belong to."""
    assert rules("a.py", "class A:\n    seen: int\n\n\nA().seen = f(known=a.own)\n") == []


def test_english_of_tests_is_not_looked_at():
    assert rules("tests/test_a.py", "# Drops so many frames.\n") == []
