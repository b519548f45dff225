"""The lint of habits of English: what each rule meets, and what it leaves."""

from __future__ import annotations

import plain
import pytest


def rules(file, source):
    return [each.rule.partition(":")[0] for each in plain.findings(file, source)]


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


def test_the_first_word_of_a_docstring_is_looked_at_and_that_of_a_message_is_not():
    assert rules("a.py", '"""Whether it is."""\n') == [plain.BEGIN]
    assert rules("a.py", 'raise ValueError("Which one is it?")\n') == []


@pytest.mark.parametrize(
    "source", ["    so many lines of code\n", "```\nso many\n```\n", "| so many |\n", "Use `so many`.\n"]
)
def test_code_and_tables_of_a_page_are_left(source):
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


def test_the_line_of_a_finding_is_that_of_the_word():
    found = list(plain.findings("a.py", '"""Return a.\n\nDrops so many.\n"""\n'))
    assert [each.line for each in found] == [3]


def test_plain_sentences_pass(tmp_path, capsys):
    file = tmp_path / "page.md"
    file.write_text("Fuse label maps. The map is where the tables are.\n")
    assert plain.main([str(file)]) == 0
    file.write_text("It is drawn anew.\n")
    assert plain.main([str(file)]) == 1
    assert f"{file}:1: anew" in capsys.readouterr().out
