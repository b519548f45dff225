"""The command line `semstab-bench`. Heavy imports are inside the commands, so that --help answers at once."""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from semstab import __version__
from semstab.cli.dataset_commands import check, convert, predict
from semstab.cli.options import say
from semstab.cli.result_commands import calibrate, compare, conform, export, gate, leaderboard, maps, relabel
from semstab.cli.run_commands import benchmark, filters, run, study
from semstab.cli.show_commands import list_, show, view
from semstab.core.process import configure_process
from semstab.errors import OUT_OF_MEMORY, ConfigError, SemstabError, printable, summarize_error

# Ctrl-C may interrupt any code: an import, a callback from compiled code.


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C, TERM and HUP raise KeyboardInterrupt, even if code inside the block turns it into another error.

    An interrupted import may fail with another error, which becomes KeyboardInterrupt again. An error in a callback is
    normally printed and dropped; here it is not printed.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        yield
        return
    came: list[int] = []
    ended: dict[int, Any] = {}

    def interrupt(number: int, _frame: Any) -> None:
        came.append(number)
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt(number)

    hook = sys.unraisablehook
    for signal_number in ENDINGS:
        if signal.getsignal(signal_number) != signal.SIG_IGN:  # nohup
            ended[signal_number] = signal.signal(signal_number, interrupt)
    try:
        yield
    except Exception as error:
        if came:
            raise KeyboardInterrupt(came[0]) from error
        raise
    finally:
        for ending, before in ended.items():
            signal.signal(ending, before)
        sys.unraisablehook = hook


ENDINGS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
"""Signals that end a command in one line."""

RESUMED = ("run", "study", "benchmark", "filters", "predict", "convert")
"""The commands that go on where they were."""


def _interrupted(command: str | None, folder: Path | None) -> str:
    """Return the message of a command that a signal ended; its folder may not be on the command line."""
    if command in RESUMED:
        out_option = "the same --out" if folder is None else f"--out {folder}"
        return f"interrupted; finished work is stored, and the same command with {out_option} resumes there"
    return "interrupted; no file is half-written; start the same command again"


def _without_kind(options: list[Any]) -> list[Any]:
    """Return options whose flags show no kind of value, as they take none."""
    for option in options:
        if getattr(option, "is_flag", False):
            option.metavar = ""
    return options


class Command(TyperCommand):
    """A command whose flags show no kind of value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return its parameters, and --help."""
        return _without_kind(super().get_params(ctx))


OF_PATHS = ("run", "check", "predict")
"""The commands whose first word may be a path, as with --data."""


def _is_path(word: str) -> bool:
    """Return whether a word that is no command is meant as a path: of a file or folder, or with a suffix."""
    return os.sep in word or bool(Path(word).suffix) or Path(word).exists()


UsageError: Any = next(parent for parent in typer.BadParameter.__mro__ if parent.__name__ == "UsageError")
"""The error of a command line that the options do not allow: typer exports only its subclass."""


def _usage(error: Any) -> str:
    """Return what is wrong with a command line, with the option that may have been meant."""
    option = getattr(error, "option_name", None)
    if option is None or not hasattr(error, "possibilities"):  # for example an option without its argument
        text: str = error.format_message()
        return text.rstrip(".")
    near = difflib.get_close_matches(option, error.possibilities or (), n=1)
    return f"no such option: {option}" + (f"; did you mean {near[0]}?" if near else "")


class CommandGroup(TyperGroup):
    """Group that runs `run` by default, shows the options of `run` in the help, and reports every error in one line."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options that stand before the command, and --help."""
        return _without_kind(super().get_params(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `run` in front of bare options."""
        of_group = {"--help", "-h", "--version", "--install-completion", "--show-completion"}
        if not args or (args[0].startswith("-") and args[0] not in of_group):
            args = ["run", *args]
        if args[0] not in self.commands and args[0] not in of_group and _is_path(args[0]):
            args = ["run", "--data", *args]
        if args[0] in OF_PATHS and len(args) > 1 and not args[1].startswith("-"):
            args = [args[0], "--data", *args[1:]]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the first word names; it may also have been meant as a path."""
        word = args[0]
        if word not in self.commands and not word.startswith("-") and not ctx.resilient_parsing:
            paths = [path.name for path in Path().iterdir()]
            near = difflib.get_close_matches(word, [*self.commands, *paths], n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"commands: {', '.join(self.commands)}"
            raise ConfigError(f"'{word}' is no command, and there is no such file or folder; {hint}")
        return super().resolve_command(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the group's own help, with the options of `run` in it."""
        params = self.params
        self.params = [*params, *self.commands["run"].params]
        try:
            super().format_help(ctx, formatter)
        finally:
            self.params = params

    def invoke(self, ctx: Any) -> Any:
        """Report every error in one line; bad input gives exit code 2."""
        try:
            with interruptible():
                return super().invoke(ctx)
        except SemstabError as error:
            say(f"error: {error}")
            raise typer.Exit(error.exit_code) from error
        except UsageError as error:
            command = " ".join(filter(None, ("semstab-bench", ctx.invoked_subcommand)))
            say(f"error: {_usage(error)}; see {command} --help")
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            folder = next((argument for argument in error.args if isinstance(argument, Path)), None)
            say(_interrupted(ctx.invoked_subcommand, folder))
            number = next((argument for argument in error.args if isinstance(argument, int)), signal.SIGINT)
            raise typer.Exit(128 + number) from error
        except OSError as error:
            say(f"error: {error.filename or 'input or output'}: {error.strerror or error}")
            raise typer.Exit(2) from error
        except ImportError as error:
            what = f"{error.name or 'a package'} cannot be loaded ({summarize_error(error)})"
            say(f"error: {what}; install semstab again, or give the process more memory (ulimit -v)")
            raise typer.Exit(2) from error
        except MemoryError as error:
            say(f"error: {OUT_OF_MEMORY}")
            raise typer.Exit(2) from error


app = typer.Typer(
    cls=CommandGroup,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="How stable are a segmentation model's predictions at the same physical place?\n\n"
    "Fuses label maps by depth and pose into metric voxels, and measures how far views of one place agree (alpha,"
    " VSS), and how their labels drift (SBD) and flicker. Without a command `run` is the command; without options it"
    " runs on the built-in city.",
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"semstab {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take the options that stand before the command."""


COMMANDS: Mapping[Callable[..., None], tuple[str, str]] = {
    run: ("run --data flight --out now", "run --data flight --model net --frames ::2 --out thinned"),
    study: ("study mine.yaml --out sweep", "study mine.yaml --only voxel_size --jobs 2"),
    benchmark: ("benchmark city@1 --predict net.py:Net", "benchmark mine@1.yaml --data flight"),
    predict: (
        "predict --model colour-clusters --data flight", "predict --model net.py:Net --data flight --name mine",
    ),
    check: ("check --data flight", "check --data flight --json flight.json"),
    convert: ("convert --data flight --out same", "convert --data flight --out small --depth-error 0.002"),
    compare: ("compare old new", "compare old new --out versus"),
    filters: (
        "filters --data flight --model net --out steadier", "filters --data flight --model net --filter ema:0.6",
    ),
    gate: ("gate new --against old --rule 'alpha drop < 0.02'", "gate new --rule 'alpha > 0.6' --out gate.md"),
    leaderboard: ("leaderboard results", "leaderboard results --out site"),
    calibrate: ("calibrate judged --out thresholds.yaml", "calibrate judged --precision 0.9 --out thresholds.yaml"),
    export: ("export new --to map.ply", "export new --to voxels.csv --min-op 3"),
    maps: ("maps new map.ply", "maps new map.ply other.parquet --out beside"),
    relabel: ("relabel new --out fused", "relabel new --out steady --category stable"),
    conform: ("conform './fuse'", "conform './fuse' --only pinhole"),
    show: ("show new overview --out overview.tex", "show old new --out glance"),
    view: ("view new", "view new/recording.rrd"),
    list_: ("list", "list --check"),
}  # fmt: skip
"""The commands, with two command lines of each, of a scene `flight` and of finished runs, which end its help."""

EXAMPLES = {command.__name__.rstrip("_"): lines for command, lines in COMMANDS.items()}

for command, examples in COMMANDS.items():
    lines = [f"semstab-bench {line}" for line in examples]
    app.command(command.__name__.rstrip("_"), cls=Command, epilog="\n\n".join(["Examples:", *lines]))(command)


class _Once(logging.Filter):
    """A filter that passes each warning of the check and the run once, as a line for people."""

    def __init__(self) -> None:
        super().__init__()
        self._printed: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the message is new."""
        message = record.getMessage()
        new = message not in self._printed
        self._printed.add(message)
        record.msg, record.args = printable(message, keep="\n"), ()
        return new


def main() -> None:
    """Run the command line; the entry point of the console script."""
    configure_process()
    logging.getLogger("semstab").addFilter(_Once())
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names may hold characters that the terminal cannot show
    app()
