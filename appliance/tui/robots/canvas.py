"""Cells of a terminal to draw on: braille dots, and signs above them; read as lines of styled pieces. Pure."""

from msgspec import Struct
from rich.cells import cell_len

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a braille cell by row and column (Unicode block 2800)."""
_BRAILLE = [chr(0x2800 + bits) for bits in range(256)]


class Line(Struct, frozen=True):
    """A line of the map: pieces of text, each with its style, that together have its width."""

    pieces: tuple[tuple[str, str], ...]

    @property
    def plain(self) -> str:
        """Its characters."""
        return "".join(text for text, _ in self.pieces)


class Canvas:
    """Cells with dots, and signs above them, row by row."""

    def __init__(self, columns: int, rows: int) -> None:
        self.columns, self.rows = columns, rows
        self._dots = [bytearray(columns) for _ in range(rows)]
        self._styles: list[list[str]] = [[""] * columns for _ in range(rows)]
        self._taken = [bytearray(columns) for _ in range(rows)]
        """Cells that have a sign."""
        self._signs: list[dict[int, tuple[str, str]]] = [{} for _ in range(rows)]
        """By column: character and style; a wide character has an empty one after it."""

    def dot(self, column: int, up: int, style: str) -> None:
        """Set a dot, counted from the lower left."""
        down = self.rows * 4 - 1 - up
        if 0 <= column < self.columns * 2 and 0 <= down < self.rows * 4:
            self._dots[down >> 2][column >> 1] |= _DOTS[down & 3][column & 1]
            self._styles[down >> 2][column >> 1] = style

    def cell(self, column: int, up: int) -> tuple[int, int] | None:
        """Return the cell of a dot; None outside."""
        row, cell = self.rows - 1 - up // 4, column // 2
        return (row, cell) if 0 <= row < self.rows and 0 <= cell < self.columns else None

    def free(self, row: int, column: int, cells: int) -> bool:
        """Whether so many cells are on the map and have no sign."""
        if not (0 <= row < self.rows and 0 <= column <= self.columns - cells):
            return False
        return self._taken[row].find(1, column, column + cells) < 0

    def write(self, row: int, column: int, text: str, style: str) -> None:
        """Write text from a cell on; what has no room any more is left out."""
        signs, taken = self._signs[row], self._taken[row]
        for each in text:
            width = 1 if each.isascii() else cell_len(each)
            if not width or column + width > self.columns:
                continue
            signs[column] = (each, style)
            taken[column] = 1
            for more in range(column + 1, column + width):
                signs[more] = ("", style)
                taken[more] = 1
            column += width

    def lines(self) -> list[Line]:
        """Return the rows."""
        return [self._line(row) for row in range(self.rows)]

    def _line(self, row: int) -> Line:
        dots, styles, signs = self._dots[row], self._styles[row], self._signs[row]
        pieces: list[tuple[str, str]] = []
        now: list[str] = []
        style_now = ""
        for column in range(self.columns):
            if column in signs:
                character, style = signs[column]
            elif dots[column]:
                character, style = _BRAILLE[dots[column]], styles[column]
            else:
                character, style = " ", ""
            if style != style_now:
                if now:
                    pieces.append(("".join(now), style_now))
                    now = []
                style_now = style
            now.append(character)
        pieces.append(("".join(now), style_now))
        return Line(tuple(pieces))
