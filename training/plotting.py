"""Pictures that do not depend on the user's settings of matplotlib: matplotlibrc, style, backend, LaTeX."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modsoft.runtime.errors import OutputError, UsageError
from modsoft.runtime.files import written

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(draw: Callable[[], Figure], out: Path, dpi: int) -> None:
    """Writes the figure of `draw` to `out`, completely or not at all, in the format of its suffix (none: PNG).

    Raises `UsageError` for an unknown suffix, `OutputError` where matplotlib fails or the file cannot be written.
    """
    matplotlib = _imported()
    with matplotlib.rc_context(), written(out) as temporary:
        matplotlib.rcdefaults()
        figure = draw()
        image_format = out.suffix[1:].lower() or "png"
        known = figure.canvas.get_supported_filetypes()
        if image_format not in known:
            raise UsageError(
                f"{out}: the picture cannot be written as {image_format} (but as {', '.join(known)}); "
                "give --out FILE.png"
            )
        try:
            figure.savefig(temporary, dpi=dpi, format=image_format)
        except OSError:
            raise
        except Exception as error:
            raise OutputError(f"{out}: not drawn ({_one_line(error)})") from error


def figure(width_in: float, height_in: float) -> Figure:
    """An empty figure, without pyplot and therefore without a window."""
    _imported()
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _imported() -> Any:
    """matplotlib; `OutputError` where a file of the user prevents the import."""
    is_first = "matplotlib" not in sys.modules
    try:
        with _without_backend() as backend:
            import matplotlib
    except ImportError:
        raise
    except Exception as error:  # for instance of the encoding of a file
        raise OutputError(f"no picture: matplotlib does not start ({_one_line(error)})") from error
    if is_first and backend is not None:  # for the user's own figures, in a program that uses modsoft as a library
        with contextlib.suppress(ValueError, ImportError):
            matplotlib.rcParams["backend"] = backend
    return matplotlib


@contextlib.contextmanager
def _without_backend() -> Iterator[str | None]:
    """Without MPLBACKEND: commands inherit it from a notebook, and its backend may not be installed for them."""
    backend = os.environ.pop("MPLBACKEND", None)
    try:
        yield backend
    finally:
        if backend is not None:
            os.environ["MPLBACKEND"] = backend


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]} ..."
