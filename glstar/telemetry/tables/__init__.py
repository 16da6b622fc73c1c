"""Tables of text, Parquet and Excel: in glstar's own columns, or in other programs' columns by a column map.

The cells of Parquet and Excel files are read here, within limits.
"""

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError, reading
from glstar.system.userinput import Unpacking, limit_of, refuse_more

Cells = Sequence[Any] | NDArray[Any]

# The last row and column of a sheet: https://support.microsoft.com, specifications and limits of Excel.
_EXCEL_ROWS, _EXCEL_COLUMNS = 1_048_576, 16_384


class ParquetColumns(Mapping[str, Cells]):
    """The columns of a Parquet file, each read when it is needed: flight tables have hundreds that are not."""

    def __init__(self, path: str, table: Any, rows: int) -> None:
        self._path, self._table, self._rows = path, table, rows
        self._read: dict[str, Cells] = {}
        self._names = dict.fromkeys(table.schema_arrow.names)

    def __getitem__(self, name: str) -> Cells:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._read:
            with reading(self._path, LogFormatError, "cannot be read as Parquet"):
                self._read[name] = self._column(name)
        return self._read[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _column(self, name: str) -> Cells:
        """Return the cells of a column: an array of numbers or times, or a list with None for nothing."""
        import pyarrow as pa  # noqa: PLC0415 - an extra, which has been imported

        kinds = pa.types
        of = self._table.schema_arrow.field(name).type
        of = of.value_type if kinds.is_dictionary(of) else of
        is_number = kinds.is_integer(of) or kinds.is_floating(of) or kinds.is_decimal(of)
        is_text = kinds.is_string(of) or kinds.is_large_string(of)
        if not (is_number or is_text or kinds.is_timestamp(of) or kinds.is_date(of) or kinds.is_boolean(of)):
            raise ValueError(f"its column {name} holds {of}, not numbers, times or text")
        refuse_more("content_mib", self._unpacked_bytes(name), f"its column {name} unpacks to more than glstar takes")
        column = self._table.read(columns=[name]).column(0)
        if len(column) != self._rows:
            raise ValueError(f"its column {name} has {len(column)} rows, where the file states {self._rows}")
        if kinds.is_timestamp(of) or kinds.is_date(of):
            return np.asarray(column.to_numpy(zero_copy_only=False), dtype=None if kinds.is_timestamp(of) else "M8[D]")
        if is_text:
            texts = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
            values = texts.dictionary.to_pylist()
            return [None if at is None else values[at] for at in texts.indices.to_pylist()]
        if kinds.is_integer(of) or kinds.is_floating(of):
            numbers: NDArray[Any] = column.to_numpy(zero_copy_only=False)
            return numbers if column.null_count == 0 else numbers.astype(np.float64)
        cells: list[Any] = column.to_pylist()
        return cells

    def _unpacked_bytes(self, name: str) -> int:
        """Return the size of a column as the file states it."""
        metadata, total = self._table.metadata, 0
        for group in range(metadata.num_row_groups):
            columns = metadata.row_group(group)
            total += sum(
                columns.column(at).total_uncompressed_size
                for at in range(columns.num_columns)
                if columns.column(at).path_in_schema == name
            )
        return total


def excel_rows(path: str) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """Yield the numbers and the cells of the rows of the first sheet that have some."""
    import openpyxl  # noqa: PLC0415 - an extra, which has been imported

    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        refuse_more("members", len(members))
        Unpacking(Path(path).stat().st_size, "content_mib").add(sum(member.file_size for member in members))
    # Opened here, because openpyxl leaves a damaged file open.
    with Path(path).open("rb") as file, closing(openpyxl.load_workbook(file, read_only=True, data_only=True)) as book:
        if not book.worksheets:
            raise ValueError("has no sheet")
        sheet = book.worksheets[0]
        # The stated dimension may be smaller than the sheet.
        sheet.reset_dimensions()
        count, most_rows, most_cells = 0, limit_of("rows"), limit_of("cells")
        for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
            count += len(row)
            if number > _EXCEL_ROWS or len(row) > _EXCEL_COLUMNS:
                raise ValueError("has a cell beyond the last row or column of Excel")
            if number > most_rows:
                refuse_more("rows", number)
            if count > most_cells:
                refuse_more("cells", count)
            if any(cell is not None for cell in row):
                yield number, row
