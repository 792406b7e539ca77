"""What a job gives: it shows itself at a prompt by its report, and saves the report's files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bwbayes.shown import head

if TYPE_CHECKING:
    from bwbayes.record.record import Record
    from bwbayes.report.report import Report


class Shown:
    """What shows itself by its report: its head as a repr, all of it in print and a notebook."""

    @property
    def heading(self) -> str:
        """What is said above the report, if anything."""
        return ""

    def report(self) -> Report:
        """Return all that there is to say of it."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return head(str(self))

    def __str__(self) -> str:
        from bwbayes.report.screen import as_text  # noqa: PLC0415  # slow to load

        return "\n".join(filter(None, [self.heading, as_text(self.report())]))

    def _repr_html_(self) -> str:
        from bwbayes.report.page import fragment  # noqa: PLC0415  # slow to load

        report = self.report()
        return fragment(replace(report, title=self.heading or report.title))


class Product(Shown):
    """A product with a report; its files are called by its ``NAME``."""

    NAME: ClassVar[str]

    def records(self) -> dict[str, Record]:
        """Return what is saved beside the report, as CSV, by name."""
        return {}

    def save(self, folder: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write page, table, numbers and records to a folder, and return them.

        Raises
        ------
        InputError
            A file that exists, unless it may be replaced, or that cannot be written.
        """
        from bwbayes.record.io.formats import write_record  # noqa: PLC0415  # slow to load
        from bwbayes.report.outputs import refuse_existing, save  # noqa: PLC0415

        folder = Path(folder)
        records = {folder / f"{name}.csv": record for name, record in self.records().items()}
        pages = [folder / f"{self.NAME}.{kind}" for kind in ("json", "csv", "html")]
        refuse_existing([*records, *pages], overwrite=overwrite)
        files = save(self.report(), folder, self.NAME)
        for path, record in records.items():
            write_record(record, path)
        return [*records, *files]
