"""HTML pages that need no network connection: images and rotatable point clouds in one file.

`page` makes the document; the other functions make the parts of its body.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import plotly.offline
from matplotlib.figure import Figure
from matplotlib.image import imsave
from torch import Tensor

from train.files import write_text

_STYLE = """
body { margin: 0; background: #f6f8f9; color: #1c2733; font: 16px/1.55 system-ui, "Segoe UI", sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
h1 { font-size: 1.9rem; margin: 0 0 .2rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .4rem; }
p { max-width: 46rem; }
.subtitle, figcaption { color: #6b7785; }
figure { margin: 1rem 0; }
figcaption { font-size: .9rem; margin-top: .3rem; }
figure > img { max-width: 100%; background: white; border: 1px solid #dde3e8; border-radius: 6px; }
.row { display: flex; flex-wrap: wrap; gap: .8rem; align-items: flex-start; }
.row > figure { margin: 0; }
.cloud { flex: 0 0 100%; }
.pair > .cloud { flex: 0 0 calc(50% - .4rem); }
.inputs img { width: 116px; }
.cloud > div { background: white; border: 1px solid #dde3e8; border-radius: 6px; overflow: hidden; }
table { border-collapse: collapse; background: white; border: 1px solid #dde3e8; }
th, td { padding: .3rem .8rem; text-align: right; border-bottom: 1px solid #eef1f4; }
th:first-child, td:first-child { text-align: left; white-space: nowrap; }
pre { background: white; border: 1px solid #dde3e8; padding: .8rem; overflow-x: auto; font-size: .8rem; }
"""


def write_reconstruction_page(
    path: str | Path, images: Tensor, points: Tensor, *, title: str, subtitle: str = ""
) -> None:
    """Writes a page with the images of an object and its reconstruction, which can be turned with the mouse.

    Args:
        path: the .html file.
        images: (V, 3, H, W) in [0, 1].
        points: (M, 3), y up.
        title: headline.
        subtitle: a line below it.
    """
    inputs = [picture(image, f"image {number}") for number, image in enumerate(images, 1)]
    body = [
        "<h2>Input images</h2>",
        row(inputs, kind="inputs"),
        "<h2>Reconstruction</h2>",
        row([cloud(points, "Drag to turn, scroll to zoom. Colour is height.", height_px=640)]),
    ]
    write_text(Path(path), page(title, body, subtitle=subtitle))


def page(title: str, body: Sequence[str], *, subtitle: str = "") -> str:
    """A complete page; it includes plotly's library if it contains a cloud."""
    library = ""
    if any("Plotly.newPlot" in part for part in body):
        library = f"<script>{plotly.offline.get_plotlyjs()}</script>"
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{html.escape(title)}</title><style>{_STYLE}</style>{library}</head><body><main>",
            f'<h1>{html.escape(title)}</h1><p class="subtitle">{html.escape(subtitle)}</p>',
            *body,
            "</main></body></html>\n",
        ]
    )


def paragraph(text: str) -> str:
    """Plain text."""
    return f"<p>{html.escape(text)}</p>"


def row(parts: Sequence[str], *, kind: str = "") -> str:
    """Parts side by side, wrapped at the window's width."""
    return f'<div class="row {kind}">{"".join(parts)}</div>'


def picture(image: Tensor, caption: str) -> str:
    """An image (3, H, W) in [0, 1] with a line of text."""
    buffer = io.BytesIO()
    imsave(buffer, image.permute(1, 2, 0).clamp(0, 1).cpu().numpy(), format="png")
    return _embedded(buffer.getvalue(), caption)


def drawing(figure: Figure, caption: str) -> str:
    """A matplotlib figure with a line of text."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor="white")
    return _embedded(buffer.getvalue(), caption)


def cloud(points: Tensor, caption: str, *, height_px: int = 420, colours: str = "Viridis") -> str:
    """A point cloud (M, 3), y up, that can be turned with the mouse."""
    x, y, z = coordinates = points.detach().cpu().numpy().astype(np.float32).round(4).T
    # Plotly's unit of the camera position is the cloud's mean extent; this distance shows all of the cloud.
    extent = np.ptp(coordinates, axis=1).clip(1e-3) if len(points) else np.ones(3)
    distance = 1.1 * np.linalg.norm(extent) / np.prod(extent) ** (1 / 3)
    eye = distance * np.array([0.5, 0.35, 0.79])
    marker = {"size": 3, "color": y, "colorscale": colours, "showscale": False}
    scatter = go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, hoverinfo="skip")
    hidden = {"visible": False}
    figure = go.Figure(scatter)
    figure.update_layout(
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        height=height_px,
        scene={
            "aspectmode": "data",
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
            "camera": {"up": {"x": 0, "y": 1, "z": 0}, "eye": dict(zip("xyz", eye.tolist(), strict=True))},
            "dragmode": "orbit",
        },
    )
    drawn = figure.to_html(
        full_html=False, include_plotlyjs=False, config={"displayModeBar": False, "responsive": True}
    )
    return f'<figure class="cloud"><div>{drawn}</div><figcaption>{html.escape(caption)}</figcaption></figure>'


def listing(text: str) -> str:
    """Preformatted text, for configurations."""
    return f"<pre>{html.escape(text)}</pre>"


def _embedded(png: bytes, caption: str) -> str:
    data, text = base64.b64encode(png).decode(), html.escape(caption)
    return f'<figure><img src="data:image/png;base64,{data}" alt="{text}"><figcaption>{text}</figcaption></figure>'
