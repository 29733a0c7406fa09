"""Tables on the terminal: no lines, columns as wide as what is in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_table(
    rows: Sequence[Sequence[str]], heads: Sequence[str] = (), justify: str = "lr", bold: str = "", **options: Any
) -> None:
    """Print rows of cells on standard output; without colours if that is no terminal.

    Parameters
    ----------
    rows : sequence of sequence of str
        The cells, a first one of each row its name; shown as they are, whatever brackets are in them.
    heads : sequence of str, optional
        What stands above the columns.
    justify : str, default "lr"
        "l" or "r" for each column, left or right; the last holds for all that follow.
    bold : str, optional
        Name of the row that stands out.
    **options
        Of `rich.table.Table`: a title, a caption.
    """
    table = Table(
        box=None, pad_edge=False, show_header=bool(heads), title_justify="left", caption_justify="left", **options
    )
    for at in range(max(map(len, [heads, *rows]))):
        side: Literal["left", "right"] = "left" if justify[min(at, len(justify) - 1)] == "l" else "right"
        whole = at == 0 and bool(heads) and justify != "l"  # the name of a row of figures
        table.add_column(heads[at] if heads else "", justify=side, no_wrap=whole, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row), style="bold" if bold and row[0] == bold else "")
    Console(highlight=False).print(table)
