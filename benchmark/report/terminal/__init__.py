"""Print the answer on one screen of 80 columns, progress while a run works, and failures."""

from semstab.report.terminal.layout import TEXTS, common_beginning, laid_out, percents
from semstab.report.terminal.progress import ProgressBar, failure_lines
from semstab.report.terminal.several_models import columns, miou, row_of
from semstab.report.terminal.summary import print_answer, print_summary, screen

__all__ = [
    "TEXTS",
    "ProgressBar",
    "columns",
    "common_beginning",
    "failure_lines",
    "laid_out",
    "miou",
    "percents",
    "print_answer",
    "print_summary",
    "row_of",
    "screen",
]
