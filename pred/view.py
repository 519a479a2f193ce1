# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred view RUN`: pictures of what a run renders, one per camera and one from above.

The network sees the 5 % of the fixed mask that `pred evaluate` uses too. Rendered colours fade to grey where a ray sees
little (low opacity), and they are dimmed far from every LiDAR return: there, nothing taught the network what to render.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from pred.data.batch import build_source, evaluation_batch
from pred.data.frame import CLASS_NAMES, Boxes, Camera, Frame, inside_range
from pred.models.pretrainer import Pretrainer, RenderedView
from pred.pretrain import PretrainConfig, load_model, pick_device
from pred.progress import Progress
from pred.run_folder import RunFolder

CLASS_COLOURS = np.array(
    [
        (128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (190, 153, 153), (153, 153, 153),
        (250, 170, 30), (220, 220, 0), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60),
        (255, 0, 0), (0, 0, 142), (0, 0, 70), (0, 60, 100), (0, 80, 100), (0, 0, 230), (119, 11, 32),
    ],
    dtype=np.uint8,
)  # fmt: skip
"""The colours in which Cityscapes shows its classes."""

DISTANCE_COLOURS = np.array(
    [
        (122, 4, 3),
        (218, 57, 7),
        (251, 128, 34),
        (226, 220, 56),
        (118, 254, 91),
        (26, 228, 182),
        (68, 144, 254),
        (48, 18, 59),
    ],
    dtype=np.float64,
)
"""Near to far, evenly spaced in the logarithm of the distance."""

NEAREST_M, FARTHEST_M = 2.0, 60.0
DISTANCE_TICKS_M = (2, 5, 10, 20, 40, 60)
NOTHING = np.array((60, 60, 60), dtype=np.float64)
BACKGROUND, INK = (20, 20, 20), (235, 235, 235)
MARGIN = 8
CAPTION = 20

Picture = NDArray[np.uint8]


def view(
    config: PretrainConfig,
    run: Path,
    checkpoint: Path | None = None,
    frame_index: int = 0,
    columns: int = 200,
) -> list[Path]:
    """Make the pictures of one frame in RUN/pictures and return their paths.

    Args:
        config: the run's configuration.
        run: run folder.
        checkpoint: file to use; the run's latest by default.
        frame_index: frame in the data set.
        columns: rays per image row, and per row of the picture from above.

    Raises:
        RunFolderError, CheckpointError, FrameError, ValueError: something is missing or damaged; the text names it.
    """
    if columns < 2:
        raise ValueError(f"view: columns must be at least 2, got {columns}")
    folder = RunFolder(run)
    folder.require()
    device = pick_device(config.train)
    source = build_source(config.data)
    if not 0 <= frame_index < len(source):
        raise ValueError(f"view: frame must be in [0, {len(source)}), got {frame_index}")
    network, checkpoint = load_model(config, folder, checkpoint)
    network.to(device)
    frame = source.load(frame_index)
    batch = evaluation_batch(frame, config.data, config.point_range, config.train.seed).to(device)
    with torch.no_grad():
        bev = network.encode(batch.points, batch.point_offsets)

    folder.pictures.mkdir(exist_ok=True)
    paths = []
    with Progress("picture", len(frame.cameras) + 1) as progress:
        for camera in frame.cameras:
            path = folder.pictures / f"{frame_index:06d}_{camera.name}.png"
            camera_picture(network, bev, frame, camera, config, columns).save(path)
            paths.append(path)
            progress.advance(camera.name)
        path = folder.pictures / f"{frame_index:06d}_bev.png"
        visible = batch.points[:, :3].cpu().numpy()
        bev_picture(network, bev, frame, visible, config, columns).save(path)
        paths.append(path)
        progress.advance("bev")
    progress.message(f"network: {checkpoint}")
    for path in paths:
        progress.message(str(path))
    return paths


def camera_picture(
    network: Pretrainer, bev: Tensor, frame: Frame, camera: Camera, config: PretrainConfig, columns: int
) -> Image.Image:
    """Image | pseudo label | rendered semantics | rendered distance with LiDAR points on top."""
    rows = max(1, round(columns * camera.height / camera.width))
    origins, directions = pixel_rays(camera, columns, rows)
    rendered = render(network, bev, origins, directions)
    opacity = rendered.opacity[0].reshape(rows, columns).cpu().numpy()
    distance_m = rendered.depth_m[0].reshape(rows, columns).cpu().numpy()

    size = (640, round(640 * camera.height / camera.width))
    image = Image.fromarray(camera.load_image()).resize(size) if camera.image is not None else blank(size, "no image")
    points = frame.points[frame.is_keyframe & inside_range(frame.points, config.point_range), :3]
    uv, z_depth_m = camera.project(points)
    seen = camera.in_image(uv, z_depth_m)
    taught = near_cells(uv[seen] * (columns / camera.width, rows / camera.height), (rows, columns), columns // 40)

    if camera.labels is None:
        label = blank(size, "no pseudo label")
        semantics, classes = blank(size, "not trained: no pseudo labels"), np.zeros(0, dtype=np.int64)
    else:
        label_map = camera.labels.class_map()
        label = enlarge(class_colours(label_map), size)
        rendered_map = rendered.semantics[0].argmax(-1).reshape(rows, columns).cpu().numpy()
        semantics = enlarge(dimmed(faded(CLASS_COLOURS[rendered_map], opacity), taught), size)
        classes = np.union1d(label_map[label_map < len(CLASS_NAMES)], rendered_map[taught & (opacity > 0.5)])
    distance = enlarge(dimmed(faded(distance_colours(distance_m), opacity), taught), size)
    distance_of_points_m = np.linalg.norm(points[seen] - camera.T_lidar_from_camera[:3, 3], axis=1)
    draw_points(distance, uv[seen] * (size[0] / camera.width), distance_colours(distance_of_points_m))

    return page(
        f"{camera.name}   {frame.token}",
        [
            [("image", image), ("pseudo label", label)],
            [("rendered semantics", semantics), ("rendered distance, LiDAR points on top", distance)],
        ],
        [class_legend(classes), distance_legend()],
        "dim: far from every LiDAR return",
    )


def bev_picture(
    network: Pretrainer, bev: Tensor, frame: Frame, visible: NDArray[np.float32], config: PretrainConfig, columns: int
) -> Image.Image:
    """Input points | rendered from straight above | a horizontal cut through the signed distance."""
    x_min, y_min, z_min, x_max, y_max, z_max = config.point_range
    rows = max(1, round(columns * (y_max - y_min) / (x_max - x_min)))
    x_m = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
    y_m = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows  # row 0 at the top: forward is up
    x_m, y_m = (grid.ravel() for grid in np.meshgrid(x_m, y_m))
    # Rays start near_m early, so that the first sample lies on the box.
    above = np.column_stack([x_m, y_m, np.full(len(x_m), z_max + config.renderer.near_m)])
    rendered = render(network, bev, above, np.broadcast_to((0.0, 0.0, -1.0), above.shape))
    opacity = rendered.opacity[0].reshape(rows, columns).cpu().numpy()
    has_labels = any(camera.labels is not None for camera in frame.cameras)

    cell_m = (x_max - x_min) / columns
    keyframe = frame.points[frame.is_keyframe, :2]
    taught = near_cells((keyframe - (x_min, y_max)) / (cell_m, -cell_m), (rows, columns), max(1, round(2.0 / cell_m)))
    size = (512, max(1, round(512 * rows / columns)))
    points = Image.new("RGB", size, BACKGROUND)
    draw_points_from_above(points, frame.points[:, :3], config, (90, 90, 90))
    draw_points_from_above(points, visible, config, (255, 210, 70), width=2)
    if has_labels:
        classes = rendered.semantics[0].argmax(-1).reshape(rows, columns).cpu().numpy()
        colours = CLASS_COLOURS[classes]
        legends = [class_legend(np.unique(classes[taught & (opacity > 0.5)]))]
    else:
        height_m = above[0, 2] - rendered.depth_m[0].reshape(rows, columns).cpu().numpy()
        share = ((height_m - z_min) / (z_max - z_min)).clip(0, 1)
        colours = np.repeat((share * 255).astype(np.uint8)[..., None], 3, axis=-1)
        legends = []
    top = enlarge(dimmed(faded(colours, opacity), taught), size)
    cut_z_m = cut_height(frame, config)
    sdf_m = signed_distance(network, bev, np.column_stack([x_m, y_m, np.full(len(x_m), cut_z_m)]))
    cut = enlarge(dimmed(sdf_colours(sdf_m.reshape(rows, columns)), taught), size)
    for panel in (points, top, cut):
        if frame.boxes is not None:
            draw_boxes(panel, frame.boxes, config)
    return page(
        f"from above   {frame.token}",
        [
            [
                (f"input: {len(visible)} points of {len(frame.points)}", points),
                ("rendered from above: " + ("semantics" if has_labels else "height"), top),
                (f"signed distance at z = {cut_z_m:.1f} m (blue: outside, red: inside, 1 m lines)", cut),
            ]
        ],
        legends,
        "dim: no LiDAR return within 2 m",
    )


def pixel_rays(camera: Camera, columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origins and unit directions [rows * columns, 3] in the LiDAR frame, through the centres of image cells."""
    u = (np.arange(columns) + 0.5) * camera.width / columns
    v = (np.arange(rows) + 0.5) * camera.height / rows
    u, v = (grid.ravel() for grid in np.meshgrid(u, v))
    in_camera = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(camera.intrinsics).T
    T_lidar_from_camera = camera.T_lidar_from_camera
    directions = in_camera @ T_lidar_from_camera[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(T_lidar_from_camera[:3, 3], directions.shape), directions


def render(
    network: Pretrainer, bev: Tensor, origins: NDArray[np.float64], directions: NDArray[np.float64]
) -> RenderedView:
    """Render rays [R, 3] of one frame; the result has a batch dimension of 1."""

    def tensor(array: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(array.astype(np.float32))[None].to(bev.device)

    return network.render(bev, tensor(origins), tensor(directions))


@torch.no_grad()
def signed_distance(network: Pretrainer, bev: Tensor, points_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """[N] signed distance at points [N, 3], metres."""
    points = torch.from_numpy(points_m.astype(np.float32)).to(bev.device)
    projected = network.field.project(bev)
    parts = [network.field.decode(projected, part[None], semantics=False).sdf[0] for part in points.split(65536)]
    sdf: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
    return sdf


def cut_height(frame: Frame, config: PretrainConfig) -> float:
    """A metre above the ground, the ground being the height of the lowest tenth of the returns."""
    inside = frame.points[inside_range(frame.points, config.point_range)]
    z_min, z_max = config.point_range[2], config.point_range[5]
    ground = np.quantile(inside[:, 2], 0.1) if len(inside) else z_min
    return float(np.clip(ground + 1.0, z_min, z_max))


def class_colours(class_map: NDArray[np.uint8]) -> Picture:
    """[h, w, 3] palette colours; black where there is no class."""
    colours = np.zeros((256, 3), dtype=np.uint8)
    colours[: len(CLASS_COLOURS)] = CLASS_COLOURS
    return colours[class_map]


def distance_colours(distance_m: NDArray[np.floating]) -> Picture:
    """[..., 3] colours of distances, logarithmic from near (red) to far (blue)."""
    span = np.log(FARTHEST_M / NEAREST_M)
    share = np.log(np.clip(distance_m, NEAREST_M, FARTHEST_M) / NEAREST_M) / span
    position = share * (len(DISTANCE_COLOURS) - 1)
    low = np.minimum(position.astype(np.int64), len(DISTANCE_COLOURS) - 2)
    blend = (position - low)[..., None]
    return np.asarray(DISTANCE_COLOURS[low] * (1 - blend) + DISTANCE_COLOURS[low + 1] * blend, dtype=np.uint8)


def sdf_colours(sdf_m: NDArray[np.floating]) -> Picture:
    """[h, w, 3]: blue outside, red inside, paler with distance, a dark line at every whole metre."""
    strength = np.exp(-np.abs(sdf_m) / 3.0)[..., None]
    base = np.where(sdf_m[..., None] >= 0, (40, 90, 200), (210, 50, 40))
    colours = 255 - strength * (255 - base)
    # A cell is on a line where the whole metre differs from its right or lower neighbour's.
    metre = np.floor(sdf_m)
    line = np.zeros(sdf_m.shape, dtype=bool)
    line[:, :-1] |= metre[:, :-1] != metre[:, 1:]
    line[:-1] |= metre[:-1] != metre[1:]
    colours[line & (np.abs(sdf_m) < 8)] *= 0.75
    return colours.astype(np.uint8)


def faded(colours: Picture, opacity: NDArray[np.floating]) -> Picture:
    """Colours mixed with grey where little was seen."""
    share = np.clip(opacity, 0, 1)[..., None]
    return np.asarray(colours * share + NOTHING * (1 - share), dtype=np.uint8)


def dimmed(colours: Picture, taught: NDArray[np.bool_]) -> Picture:
    """Darker where the network was taught nothing."""
    return np.where(taught[..., None], colours, (colours * 0.35).astype(np.uint8))


def near_cells(cells: NDArray[np.floating], shape: tuple[int, int], radius: int) -> NDArray[np.bool_]:
    """[rows, columns] mask of the grid cells at most ``radius`` rows and columns from one of N (column, row)."""
    rows, columns = shape
    counts = np.zeros((rows + 2 * radius + 1, columns + 2 * radius + 1), dtype=np.int64)
    column, row = np.floor(cells).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    counts[row[inside] + radius + 1, column[inside] + radius + 1] = 1
    sums = counts.cumsum(axis=0).cumsum(axis=1)  # box sums by differences of a summed-area table
    width = 2 * radius + 1
    boxes = sums[width:, width:] - sums[:-width, width:] - sums[width:, :-width] + sums[:-width, :-width]
    return boxes > 0


def enlarge(picture: Picture, size: tuple[int, int]) -> Image.Image:
    """Resize without mixing colours: they are classes."""
    return Image.fromarray(picture).resize(size, Image.Resampling.NEAREST)


def blank(size: tuple[int, int], text: str) -> Image.Image:
    """A grey panel that says why it is empty."""
    panel = Image.new("RGB", size, tuple(int(c) for c in NOTHING))
    ImageDraw.Draw(panel).text((size[0] / 2, size[1] / 2), text, fill=INK, font=font(), anchor="mm")
    return panel


def draw_points(panel: Image.Image, pixels: NDArray[np.float64], colours: Picture) -> None:
    """Dots of 3 x 3 at pixels [N, 2] in colours [N, 3]."""
    draw = ImageDraw.Draw(panel)
    for (x, y), colour in zip(pixels.tolist(), colours.tolist(), strict=True):
        draw.rectangle((x - 1, y - 1, x + 1, y + 1), fill=tuple(colour))


def draw_points_from_above(
    panel: Image.Image,
    points: NDArray[np.float32],
    config: PretrainConfig,
    colour: tuple[int, int, int],
    width: int = 1,
) -> None:
    """Points [N, 3] inside the range as squares of ``width`` pixels."""
    pixels = pixels_from_above(points[inside_range(points, config.point_range), :2], panel, config)
    draw = ImageDraw.Draw(panel)
    for x, y in np.floor(pixels).tolist():
        draw.rectangle((x, y, x + width - 1, y + width - 1), fill=colour)


def draw_boxes(panel: Image.Image, boxes: Boxes, config: PretrainConfig) -> None:
    """Outlines of boxes, with a line from the centre to the front."""
    draw = ImageDraw.Draw(panel)
    for centre, size, yaw in zip(boxes.centre_m, boxes.size_m, boxes.yaw_rad, strict=True):
        forward = np.array((np.cos(yaw), np.sin(yaw))) * size[0] / 2
        left = np.array((-np.sin(yaw), np.cos(yaw))) * size[1] / 2
        corners = [forward + left, forward - left, -forward - left, -forward + left, forward + left, forward, 0 * left]
        outline = pixels_from_above(centre[:2] + np.array(corners), panel, config)
        draw.line([tuple(pixel) for pixel in outline.tolist()], fill=(0, 200, 120), width=1)


def pixels_from_above(xy_m: NDArray[np.floating], panel: Image.Image, config: PretrainConfig) -> NDArray[np.float64]:
    """Panel pixels [N, 2] of positions [N, 2]; y points up."""
    x_min, y_min, _, x_max, y_max, _ = config.point_range
    x = (xy_m[:, 0] - x_min) / (x_max - x_min) * panel.width
    y = (y_max - xy_m[:, 1]) / (y_max - y_min) * panel.height
    return np.column_stack([x, y])


def page(title: str, rows: list[list[tuple[str, Image.Image]]], legends: list[Image.Image], note: str) -> Image.Image:
    """Captioned panels in rows, a title and a note above and legends below."""
    width = max(sum(panel.width + MARGIN for _, panel in row) for row in rows) + MARGIN
    heights = [max(panel.height for _, panel in row) + CAPTION + MARGIN for row in rows]
    height = CAPTION + MARGIN + sum(heights) + sum(legend.height + MARGIN for legend in legends)
    sheet = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN // 2), title, fill=INK, font=font())
    draw.text((width - MARGIN, MARGIN // 2), note, fill=INK, font=font(), anchor="ra")
    y = CAPTION + MARGIN
    for row, row_height in zip(rows, heights, strict=True):
        x = MARGIN
        for caption, panel in row:
            draw.text((x, y), caption, fill=INK, font=font())
            sheet.paste(panel, (x, y + CAPTION))
            x += panel.width + MARGIN
        y += row_height
    for legend in legends:
        sheet.paste(legend, (MARGIN, y))
        y += legend.height + MARGIN
    return sheet


def class_legend(classes: NDArray[np.integer]) -> Image.Image:
    """Colour and name of each class."""
    legend = Image.new("RGB", (1280, CAPTION if len(classes) <= 12 else 2 * CAPTION), BACKGROUND)
    draw = ImageDraw.Draw(legend)
    for place, index in enumerate(classes.tolist()):
        x, y = place % 12 * 106, place // 12 * CAPTION
        draw.rectangle((x, y + 3, x + 12, y + 15), fill=tuple(CLASS_COLOURS[index].tolist()))
        draw.text((x + 17, y), CLASS_NAMES[index], fill=INK, font=font())
    return legend


def distance_legend() -> Image.Image:
    """Colour bar of distances with ticks in metres."""
    width = 640
    legend = Image.new("RGB", (width + 60, 2 * CAPTION), BACKGROUND)
    distances = NEAREST_M * (FARTHEST_M / NEAREST_M) ** (np.arange(width) / (width - 1))
    bar = np.broadcast_to(distance_colours(distances), (14, width, 3))
    legend.paste(Image.fromarray(np.ascontiguousarray(bar)), (0, 0))
    draw = ImageDraw.Draw(legend)
    for tick in DISTANCE_TICKS_M:
        x = np.log(tick / NEAREST_M) / np.log(FARTHEST_M / NEAREST_M) * (width - 1)
        anchor = "lt" if tick == NEAREST_M else "mt"
        draw.text((x, 18), f"{tick} m", fill=INK, font=font(), anchor=anchor)
    return legend


def font() -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    """Pillow's own font."""
    return ImageFont.load_default(14)
