"""Reports of products: a title, banners, tables, figures and texts, in their order.

A :class:`Product` describes itself by a :class:`Report`. :func:`show` shows it on a terminal of 80
columns, :mod:`~bwbayes.report.result` as a page, whose files it writes. The page shows the whole
report. The screen shows the banners, and the tables and texts that are meant for it. A text is
escaped when it is shown; a :class:`~markupsafe.Markup` counts as HTML. Numbers are written as
exactly as they are known, and symbols in plain characters.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from markupsafe import Markup
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from bwbayes.errors import ExitStatus
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.shown import head
from bwbayes.watching import Watch, unwatched

if TYPE_CHECKING:
    from matplotlib import figure

    from bwbayes.diagnosis.validation import ValidationSummary
    from bwbayes.inference.parameters import Parameter
    from bwbayes.prediction.bands import Scores
    from bwbayes.record.record import Record

# A figure of matplotlib, which is loaded when something is drawn.
type Figure = "figure.Figure"  # quoted, for those who evaluate it

# The sign for an unknown number.
UNKNOWN = "–"

Target = Literal["both", "page", "screen", "nowhere"]
Kind = Literal["good", "note", "bad"]

type Block = Table | Picture | Facts | Text | Section | SideBySide


@dataclass(frozen=True)
class TableColumn:
    """A column of a table: its title, the title of its group, and where it is shown.

    ``text`` gives a cell's text for the row's item: a format with the names of the item's fields,
    such as ``"{mean:.3g}"``, or a function of the item; see :meth:`Table.of`.
    """

    title: str
    group: str = ""
    on: Target = "both"
    text: str | Callable[[Any], str] = str

    def cell(self, item: Any) -> str:
        """Return the text for a row's item; a dash if a number is not known."""
        if callable(self.text):
            return self.text(item)
        try:
            return self.text.format_map(item if isinstance(item, Mapping) else vars(item))
        except (KeyError, TypeError):
            return UNKNOWN


@dataclass(frozen=True)
class Table:
    """A table with a header for each row and column.

    ``name`` names it within the page, and its CSV; ``caption`` describes its content. ``columns``
    are columns or their titles; the first one shown holds the headers of the rows. ``rows`` are the
    texts of each row, one for each column; ``records`` are the rows of the CSV behind the page's
    button, by column, with exact numbers, by default the texts that are shown. ``note`` stands
    below it on the page; ``on`` is where it is shown.
    """

    kind: ClassVar = "table"

    name: str
    caption: str
    columns: Sequence[str | TableColumn]
    rows: Sequence[Sequence[str]]
    records: Sequence[Mapping[str, object]] = ()
    note: str = ""
    on: Target = "page"

    @classmethod
    def of(
        cls,
        name: str,
        caption: str,
        items: Iterable[Any],
        columns: Sequence[TableColumn] | Mapping[str, str],
        **rest: Any,
    ) -> Self:
        """Return a table with a row for each item, whose texts the columns write.

        Columns that are shown everywhere may be given as texts by their titles.
        """
        if isinstance(columns, Mapping):
            columns = [TableColumn(title, text=text) for title, text in columns.items()]
        rows = [[column.cell(item) for column in columns] for item in items]
        return cls(name, caption, columns, rows, **rest)

    def cells(self, target: Target) -> tuple[list[TableColumn], list[list[str]]]:
        """Return the columns, and the texts of each row, that are shown on a screen or a page."""
        columns = [
            TableColumn(column) if isinstance(column, str) else column for column in self.columns
        ]
        shown = [i for i, column in enumerate(columns) if column.on in ("both", target)]
        return [columns[i] for i in shown], [[row[i] for i in shown] for row in self.rows]


@dataclass(frozen=True)
class Picture:
    """A picture with its caption.

    ``name`` names it within the page, ``#loop``, and its file; ``title`` and ``caption`` describe
    it in a few words and at length; ``draw`` draws it; ``alt`` is the alternative text, by default
    the title.
    """

    kind: ClassVar = "picture"

    name: str
    title: str
    caption: str
    draw: Callable[[], Figure]
    alt: str = ""


@dataclass(frozen=True)
class Facts:
    """Subjects with a text each: a table of two columns, or terms and their meanings, or notes."""

    pairs: Sequence[tuple[str, str]]
    kind: Literal["facts", "terms", "notes"] = "facts"


@dataclass(frozen=True)
class Text:
    """A paragraph; a note in small letters."""

    kind: ClassVar = "text"

    text: str
    note: bool = False
    on: Target = "page"


@dataclass(frozen=True)
class Section:
    """Blocks below a heading; if folded, they are closed until the reader opens them."""

    kind: ClassVar = "section"

    title: str
    blocks: Sequence[Block]
    folded: bool = True


@dataclass(frozen=True)
class SideBySide:
    """Columns of blocks, side by side if there is room."""

    kind: ClassVar = "side"

    columns: Sequence[Sequence[Block]]


@dataclass(frozen=True)
class Banner:
    """An outcome: a headline in a color, with paragraphs, items of a list, and blocks.

    On the screen the first line follows the headline, and ``label`` stands before each item, by
    default the headline; ``blocks`` are for the page alone; ``name`` is for links to the banner.
    """

    kind: Kind
    headline: str
    lines: Sequence[str] = ()
    items: Sequence[str] = ()
    blocks: Sequence[Block] = ()
    label: str = ""
    on: Target = "both"
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Report:
    """The whole report of a product.

    ``title`` stands on the browser's tab, and at the top of the page unless ``heading``, the page's
    name, does; ``about`` describes the subject in a line. ``banners`` state the outcome, and come
    first; ``blocks`` hold the answer, then the evidence for it, then details for some readers.
    ``numbers`` are the content of the JSON file, if there is one, and ``csv`` is the text of the
    CSV file, if there is one. All of it is written for voltage and displacement, and shown in the
    words and units of its ``quantities``.
    """

    title: str
    heading: str = ""
    about: str = ""
    banners: Sequence[Banner] = ()
    blocks: Sequence[Block] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    csv: str = ""
    quantities: Quantities = DEFAULT

    def said(self) -> Report:
        """Return the report in the words of its quantities."""
        if self.quantities == DEFAULT:
            return self
        head, newline, rows = self.csv.partition("\n")
        heading = ",".join(map(self.quantities.heading, head.split(",")))
        changes = {
            "title": self.quantities.say(self.title),
            "heading": self.quantities.say(self.heading),
            "about": self.quantities.say(self.about),
            "banners": [_translate(banner, self.quantities) for banner in self.banners],
            "blocks": [_translate(block, self.quantities) for block in self.blocks],
            "numbers": self.quantities.rendered(self.numbers),
            "csv": f"{heading}{newline}{rows}",
        }
        return replace(self, **changes, quantities=DEFAULT)

    def all_blocks(self) -> Iterator[Block]:
        """Yield all blocks, including those within others, in their order."""
        yield from _flat(self.blocks)


def _translate(part: Any, quantities: Quantities) -> Any:
    """Return a part of a report in the words of quantities; names are for links and files."""
    if isinstance(part, str):
        return quantities.say(part)
    if isinstance(part, list | tuple):
        return [_translate(item, quantities) for item in part]
    if isinstance(part, Mapping):
        return {quantities.heading(key): _translate(item, quantities) for key, item in part.items()}
    if not is_dataclass(part) or isinstance(part, type):
        return part
    kept = ("name", "kind", "on")
    changes = {
        each.name: _translate(getattr(part, each.name), quantities)
        for each in fields(part)
        if each.name not in kept
    }
    return replace(part, **changes)


def _flat(blocks: Sequence[Block]) -> Iterator[Block]:
    for block in blocks:
        if isinstance(block, Section):
            yield from _flat(block.blocks)
        elif isinstance(block, SideBySide):
            for column in block.columns:
                yield from _flat(column)
        else:
            yield block


def kind_of(standing: ValidationSummary, *, good: bool = True) -> Kind:
    """Return the kind of a banner: good only if the run's validation passed, too."""
    return "good" if good and standing.passed else "note"


def remarks_banner(remarks: Sequence[str], headline: str = "Remarks") -> list[Banner]:
    """Return a banner with the remarks for the user, if there are any."""
    if not remarks:
        return []
    return [Banner("note", headline, items=remarks, label="note", name="remarks")]


def standing_banner(standing: ValidationSummary, on: Target = "both") -> list[Banner]:
    """Return a banner if the validation of a product's run failed or is inconclusive."""
    if not standing.lines:
        return []
    about = [Text("Validation of the run that this report builds on:")]
    kind: Kind = "note" if standing.passed is None else "bad"
    return [Banner(kind, standing.headline, items=standing.lines, blocks=about, on=on)]


def show(report: Report, console: Console) -> None:
    """Show the banners of a report, and the tables and texts that are meant for a screen."""
    report = report.said()
    for banner in report.banners:
        if banner.on == "page":
            continue
        color = {"good": "green", "note": "yellow", "bad": "red"}[banner.kind]
        lines = [escape(_plain(line)) for line in banner.lines]
        headline = f"[bold {color}]{escape(_plain(banner.headline))}[/]"
        label = escape(banner.label) or headline
        if lines or not banner.items:
            lines = [": ".join([headline, *lines[:1]]), *lines[1:]]
        for line in [*lines, *(f"{label}: {escape(_plain(item))}" for item in banner.items)]:
            _say(line, console)
    for block in report.all_blocks():
        if isinstance(block, Table) and block.on != "page" and block.rows:
            for grid in _grids(block, console.width):
                console.print(grid)
        elif isinstance(block, Text) and block.on != "page":
            _say(escape(_plain(block.text)), console)


def _grids(table: Table, width: int) -> Iterator[Grid]:
    """Yield a table for a screen, by groups of columns that fit beside the rows' names.

    A short text stays on one line, a title and a longer text are wrapped at their blanks.
    """
    columns, rows = table.cells("screen")
    titles = [f"{c.group}: {c.title}" if c.group else c.title for c in columns]
    texts = [[_plain(text) for text in column] for column in zip(titles, *rows, strict=True)]
    widths = [max(map(len, column)) for column in texts]
    minimum_widths = []
    for number, (title, *cells) in enumerate(texts):
        is_whole = number == 0 or max(map(len, cells)) <= 24
        words = [*title.split(), *(cells if is_whole else " ".join(cells).split())]
        minimum_widths.append(min(max(map(len, words), default=1), width // 2))
    parts = [[0]]
    for i in range(1, len(texts)):
        if len(parts[-1]) > 1 and sum(minimum_widths[n] + 2 for n in [*parts[-1], i]) > width:
            parts.append([0])
        parts[-1].append(i)
    for shown in parts:
        spare = width - sum(minimum_widths[i] + 2 for i in shown)
        grid = Grid(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        for i in shown:
            more = max(min(widths[i] - minimum_widths[i], spare), 0)
            spare -= more
            grid.add_column(escape(texts[i][0]), width=minimum_widths[i] + more, overflow="fold")
        for row in zip(*(texts[i][1:] for i in shown), strict=True):
            grid.add_row(*map(escape, row))
        yield grid


def as_text(report: Report, width: int = 110) -> str:
    """Return a report as text for a screen of so many columns."""
    text = StringIO()
    show(report, Console(file=text, width=width, force_jupyter=False, color_system=None))
    return text.getvalue().rstrip()


def _say(text: str, console: Console) -> None:
    console.print(text, highlight=False, soft_wrap=True)


def _plain(text: str) -> str:
    """Return a text without tags, in characters that every terminal shows."""
    text = Markup(text).striptags() if isinstance(text, Markup) else text
    return text.replace("µ", "u").replace("–", "-")


class Shown:
    """An object shown by its report: its head as a repr, all of it in print and in a notebook."""

    quantities: Quantities = DEFAULT  # the quantities of its run

    @property
    def heading(self) -> str:
        """The heading above the report, if any."""
        return ""

    def report(self) -> Report:
        """Return the report of the object."""
        raise NotImplementedError

    def said_in(self, quantities: Quantities) -> Self:
        """Return this object, shown in the words of these quantities from now on."""
        object.__setattr__(self, "quantities", quantities)  # most of these are frozen
        return self

    def full_report(self) -> Report:
        """Return its report, which is shown in the words of the run's quantities."""
        return replace(self.report(), quantities=self.quantities)

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        return "\n".join(filter(None, [self.heading, as_text(self.full_report())]))

    def _repr_html_(self) -> str:
        from bwbayes.report.result import fragment  # noqa: PLC0415  # slow to load

        report = self.full_report()
        return fragment(replace(report, title=self.heading or report.title))


class Product(Shown):
    """A product with a report; its files are called by its ``NAME``."""

    NAME: ClassVar[str]
    remarks: Sequence[str] = ()  # notes for the user, which its report holds, too

    @property
    def shortfall(self) -> str:
        """Reason why the product is not as requested, besides the run's validation; else empty."""
        return ""

    @property
    def exit_status(self) -> ExitStatus:
        """The exit status of its command, unless the run's validation is worse."""
        return ExitStatus.SUCCESS

    def records(self) -> dict[str, Record]:
        """Return the records that are saved beside the report, as CSV, by name."""
        return {}

    @classmethod
    def files(cls, folder: Path) -> list[Path]:
        """Return the files whose existence shows that the product is saved there already."""
        return [folder / f"{cls.NAME}.json"]

    def save(
        self, folder: str | Path, *, overwrite: bool = False, watch: Watch = unwatched
    ) -> list[Path]:
        """Write page, table, numbers and records to a folder, and return them.

        ``watch`` is called with the share of the figures that is drawn.

        Raises InputError: a file that exists, unless it may be replaced, or that cannot be written.
        """
        from bwbayes.record.io.formats import write_record  # noqa: PLC0415
        from bwbayes.report.result import refuse_existing, save  # noqa: PLC0415

        folder = Path(folder)
        records = {
            folder / f"{name}.csv": replace(
                record, quantities=self.quantities, origin=self.quantities.say(record.origin)
            )
            for name, record in self.records().items()
        }
        pages = [folder / f"{self.NAME}.{kind}" for kind in ("json", "csv", "html")]
        refuse_existing([*records, *pages], overwrite=overwrite)
        files = save(self.full_report(), folder, self.NAME, watch=watch)
        for path, record in records.items():
            write_record(record, path)
        return [*records, *files]


# Kind of banner for the outcome of a validation or of a record of a campaign; "bad" for others.
STATUS_KINDS: Mapping[str, Kind] = {
    "passed": "good",
    "inconclusive": "note",
    "validation inconclusive": "note",
}


def symbol(parameter: Parameter) -> Markup:
    r"""Return a parameter's LaTeX label as HTML, or its name if that is impossible.

    Greek letters, one subscript and ``\mathrm`` are understood.
    """

    def greek(command: re.Match[str]) -> str:
        size = "CAPITAL" if command[1][0].isupper() else "SMALL"
        try:
            return unicodedata.lookup(f"GREEK {size} LETTER {command[1].upper()}")
        except KeyError:
            return command[0]

    text = re.sub(r"\\mathrm\{(\w*)\}", r"\1", parameter.label)
    text = re.sub(r"\\([A-Za-z]+)", greek, text)
    match = re.fullmatch(r"([^\\{}_^$]+)(?:_(?:\{([^\\{}_^$]+)\}|(\w+)))?", text)
    if match is None:
        return Markup("<i>{}</i>").format(parameter.name)
    base, *below = match.groups("")
    subscript = Markup("<sub>{}</sub>").format("".join(below)) if any(below) else ""
    return Markup("<i>{}</i>").format(base) + subscript


def unit_text(unit: str) -> str:
    """Return a unit for people: um as µm, nothing for a pure number."""
    return "" if unit == "-" else re.sub(r"\bum\b", "µm", unit)


def label_with_unit(name: str, unit: str) -> str:
    """Return a name with its unit in brackets, if it has one."""
    return f"{name} ({unit_text(unit)})" if unit_text(unit) else name


def digits(value: float, sd: float) -> str:
    """Write a value as exactly as its standard deviation with two digits is written.

    ``digits(0.69712, 0.0061234)`` is ``0.6971``. A value far from one gets a power of ten.
    """
    if not (math.isfinite(value) and math.isfinite(sd) and sd > 0):
        return f"{value:.6g}"
    exponent = int(f"{sd:.1e}".partition("e")[2]) - 1
    if exponent < -7 or exponent > 3:
        leading = int(f"{value:e}".partition("e")[2]) if value else exponent
        return f"{value:.{max(leading - exponent, 0)}e}"
    # Adding zero takes the sign from a negative zero.
    return f"{round(value, -exponent) + 0.0:.{max(-exponent, 0)}f}"


def with_error(value: float, sd: float) -> str:
    """Write a value and its standard error, both to two digits of the error."""
    return f"{digits(value, sd)} ± {digits(sd, sd)}"


def length_text(um: float) -> str:
    """Write a length or an error, um, with three significant digits, also of nanometers."""
    return f"{digits(um, abs(um) / 10)} µm"


def mark(status: str) -> Markup:
    """Write an outcome: on green if it passed, amber if inconclusive, red otherwise."""
    return Markup('<span class="mark {}">{}</span>').format(STATUS_KINDS.get(status, "bad"), status)


def coverage_text(scores: Scores, kind: str, level: int) -> str:
    """Write a band's coverage with its standard error; nothing if it is not known."""
    share, error = scores.coverage[kind], scores.coverage_error[kind]
    if share is None:
        return ""
    text = f"{100 * share[level]:.1f}"
    return f"{text}%" if error is None else f"{text} ± {100 * error[level]:.1f}%"


def error_text(scores: Scores) -> str:
    """Write the NRMSE, also relative to the training range if that differs from the record's."""
    text, full = f"{100 * scores.nrmse:.2f}%", scores.nrmse_full
    # Ranges count as different if they differ by more than this part.
    if full is None or abs(full - scores.nrmse) <= 0.05 * scores.nrmse:
        return text
    return f"{text} ({100 * full:.2f}% of the training range)"


def circumstances(numbers: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the facts of the run in the summary besides its results."""
    if "seed" in numbers:
        yield "seed", str(numbers["seed"])
    wall = numbers.get("wall_s")
    if isinstance(wall, int | float):
        yield "wall time", f"{wall:.0f} s"
    if "data_sha256" in numbers:
        yield "data, SHA-256", str(numbers["data_sha256"])
    versions = numbers.get("versions")
    if isinstance(versions, Mapping):
        yield "versions", ", ".join(f"{name} {version}" for name, version in versions.items())
