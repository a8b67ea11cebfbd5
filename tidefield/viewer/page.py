"""The page of a scene: a free camera, its photographs as frustums, sparse points, and the editor of camera paths.

Everything is shown at a scale of its own, in which the usual distance to the surface is `SHOWN_DISTANCE`: the browser's
near plane, its line widths and its 24-bit depths, which end at 168 units, are made for scenes of a few units.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from tidefield.data.scene import Scene
from tidefield.errors import need
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render
from tidefield.render.camera_paths import layout_of, path_cameras
from tidefield.render.stills import colour_picture, depth_picture, depth_range
from tidefield.viewer.frames import Frame, FrameServer
from tidefield.viewer.key_frames import KeyFrame, PathEditor
from tidefield.viewer.ports import page_address, require_port
from tidefield.viewer.preview import Preview
from tidefield.viewer.words import plain, shown, without_folders

if TYPE_CHECKING:
    from viser import CameraFrustumHandle, ClientHandle, ViserServer

log = logging.getLogger(__name__)

SHOWN_DISTANCE = 5.0
FIRST_DISTANCE = 1.3
"""Of the first view to what the photographs show, in their own distances: behind them, so that they are seen."""
FRUSTUM_SIZE = 0.15
"""Of photographs, in distances between neighbouring ones."""
LARGEST_WIDTH = 800
"""Width of sharp pictures, if not given."""
FLIGHT_SECONDS, FLIGHT_STEPS = 0.6, 12
MOST_FRUSTUMS = 1000
MOST_POINTS = 100_000
THUMBNAIL_PX = 96
LAYERS = ("Colour", "Depth")


class ScenePage:
    """Serves the page of one scene.

    Args:
        scene: what is shown.
        render: how it is rendered.
        name: of the run or scene, without its folder.
        host, port: where to listen.
        width: of sharp pictures, at most.
        source: words of a command line that name what is shown; `name` if not given.
    """

    def __init__(
        self,
        scene: Scene,
        render: Render,
        name: str,
        host: str,
        port: int,
        width: int = LARGEST_WIDTH,
        source: Sequence[str] = (),
    ) -> None:
        viser = need("viser", "view")
        require_port(host, port)
        self.scene, self.source, self.width = scene, source or (name,), width
        layout = layout_of(scene)
        self.scale = SHOWN_DISTANCE / layout.distance
        self.positions = self.scale * scene.cameras.position_world.double().cpu().numpy()
        apart = np.array([self.scale])
        if len(self.positions) > 1:
            apart = KDTree(self.positions).query(self.positions, k=2)[0][:, 1]
        self.frustum_size = FRUSTUM_SIZE * float(np.median(apart))
        self._thumbnails: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
        preview = Preview(scene)
        self.frames = FrameServer(preview, render, preview.prepare)
        with redirect_stdout(StringIO()):  # viser's own table of addresses
            self.server: ViserServer = viser.ViserServer(host=host, port=port, label=shown(name), verbose=False)
        # Its button would send the page through a server of viser's makers.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="medium")
        self.server.scene.set_up_direction(layout.up)
        first = self.server.initial_camera
        back = layout.centre - FIRST_DISTANCE * layout.distance * layout.forward
        first.position, first.look_at = tuple(self.scale * back), tuple(self.scale * layout.centre)
        first.up = tuple(self._picture_up(layout.forward, layout.up))
        train = scene.cameras[list(scene.train)]
        first.fov = 2 * math.atan(float((train.size_px[:, 1] / train.focal_px[:, 1]).median()) / 2)
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(lambda client: self.frames.leave(client.client_id))

    @property
    def address(self) -> str:
        """Where the page is."""
        return page_address(self.server.get_host(), self.server.get_port())

    def close(self) -> None:
        """End the server and what it is rendering."""
        self.frames.close()
        with redirect_stdout(StringIO()):
            self.server.stop()

    def thumbnail(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """A small picture of a photograph, which is read for the first browser only."""
        if index not in self._thumbnails:
            picture = self.scene.photographs[index]
            every = max(1, picture.shape[1] // THUMBNAIL_PX)
            self._thumbnails[index] = np.ascontiguousarray(picture[::every, ::every].cpu().numpy())
        return self._thumbnails[index]

    def _picture_up(self, forward: Any, up: Any) -> Float64[np.ndarray, "3"]:
        """What is up in the first picture: away from the ground, or for a camera that looks down, along its top."""
        if abs(float(np.dot(forward, up))) < 0.95:
            return np.asarray(up, dtype=np.float64)
        tops = -self.scene.cameras[self.scene.train[0]].T_world_camera[0, :, 1]
        return tops.double().cpu().numpy()

    def _connect(self, client: ClientHandle) -> None:
        """Set up the controls of a viewer, and its first picture."""
        page = _Client(self, client)
        client.camera.on_update(lambda _: page.moved())
        page.moved()


class _Client:
    """What one browser shows."""

    def __init__(self, page: ScenePage, client: ClientHandle) -> None:
        self.page, self.client, self.last = page, client, None
        self._moves, self._asking, self._drawing = 0, threading.Lock(), threading.Lock()
        gui, scene = client.gui, page.scene
        tabs = gui.add_tab_group()
        with tabs.add_tab("View"):
            self.status = gui.add_markdown("")
            self.layer = gui.add_dropdown("Show", LAYERS)
            self.layer.on_update(lambda _: self._show_last())
            photographs = gui.add_checkbox("Photographs", True)
            points = gui.add_checkbox("Sparse points", False, disabled=scene.points is None)
            names = {shown(name): name for name in scene.names}
            choice = gui.add_dropdown("Photograph", tuple(names))
            fly = gui.add_button("Fly there")
            fly.on_click(lambda _: self.fly_to_photograph(names[choice.value]))
            link = gui.add_button("Address of this view")
            link.on_click(lambda _: self._show_address())
            self.link = gui.add_markdown("")
        with tabs.add_tab("Path"):
            self.editor = PathEditor(client, self._key_frame, self._place, page.source, scene.origin_world.tolist())
        self._add_photographs()
        cloud = self._add_points()
        photographs.on_update(lambda _: setattr(self.frustums, "visible", photographs.value))
        if cloud is not None:
            points.on_update(lambda _: setattr(cloud, "visible", points.value))

    def camera(self) -> Cameras:
        """The viewer's camera in the scene, of the size of its sharp picture."""
        own, place = self.client.camera, self._key_frame()
        width = max(16, min(own.image_width, self.page.width))
        height = max(16, round(width * own.image_height / max(own.image_width, 1)))
        focal_px = np.array([height / 2 / math.tan(min(place.fov, math.radians(150)) / 2)])
        position, rotation = place.position_world[None], place.rotation[None]
        return path_cameras(self.page.scene, position, rotation, width, height, focal_px)

    def moved(self) -> None:
        """Have the picture of where the camera is now made."""
        if not (self.client.camera.image_width and self.client.camera.image_height):
            return  # a window of no size
        self._moves += 1
        own = self._moves
        with self._asking:  # viser calls from many threads: the last camera that is read is the last that is asked for
            if own != self._moves:
                return  # a newer move waits
            self.page.frames.ask(self.client.client_id, self.camera(), self._show)
        if self.client.client_id not in self.page.server.get_clients():  # it left before it asked
            self.page.frames.leave(self.client.client_id)
            return
        away = np.linalg.norm(self.page.positions - self.client.camera.position, axis=1)
        for i, handle in self._each.items():  # one around the camera would hide the picture
            if handle.visible != bool(away[i] > 3 * self.page.frustum_size):
                handle.visible = bool(away[i] > 3 * self.page.frustum_size)

    def _show(self, frame: Frame) -> None:
        if frame.error is not None:
            words = without_folders(frame.error, [self.page.scene.root])
            self.status.content = f"**No picture:** {plain(words)}"
            return
        self.last = frame
        self._show_last()

    def _show_last(self) -> None:
        with self._drawing:  # the last that is drawn is the last frame, too
            if self.last is not None:
                self._draw(self.last)

    def _draw(self, frame: Frame) -> None:
        rendering = frame.rendering
        assert rendering is not None, "frames with errors are none to draw"
        picture = colour_picture(rendering)
        if self.layer.value == "Depth":
            near, far = depth_range(rendering)
            picture = depth_picture(rendering, near, far)
        depth = (self.page.scale * rendering.depth).float().cpu().numpy()
        depth = np.where(rendering.opacity.cpu().numpy() < 0.5, np.float32(1000), depth)
        self.client.scene.set_background_image(
            picture, "jpeg", jpeg_quality=90 if frame.sharp else 70, depth=depth if frame.sharp else None
        )
        state = "sharp" if frame.sharp else "coarse, sharp when the camera rests"
        self.status.content = f"{frame.camera.width} x {frame.camera.height}, {state}, {frame.seconds:.2f} s"

    def _add_photographs(self) -> None:
        scene, size = self.page.scene, self.page.frustum_size
        self.frustums = self.client.scene.add_frame("/photographs", show_axes=False)
        self._each: dict[int, CameraFrustumHandle] = {}
        train = set(scene.train)
        step = -(-len(scene.names) // MOST_FRUSTUMS)
        for i in range(0, len(scene.names), step):
            camera, name = scene.cameras[i], scene.names[i]
            place = _key_frame_of(camera)
            handle = self.client.scene.add_camera_frustum(
                f"/photographs/{i}",
                fov=place.fov,
                aspect=camera.width / camera.height,
                scale=size,
                thickness=0.02 * size,
                color=(30, 110, 200) if i in train else (220, 120, 20),
                image=self.page.thumbnail(i),
                jpeg_quality=70,
                wxyz=np.roll(Rotation.from_matrix(place.rotation).as_quat(), 1),
                position=self.page.positions[i],
                cast_shadow=False,
                receive_shadow=False,
            )
            self._each[i] = handle
            handle.on_click(lambda _, name=name: self.fly_to_photograph(name))

    def _add_points(self) -> Any:
        points = self.page.scene.points
        if points is None:
            return None
        xyz = points.xyz_world[:: len(points.xyz_world) // MOST_POINTS + 1].double().cpu().numpy()
        return self.client.scene.add_point_cloud(
            "/points", self.page.scale * xyz, (255, 200, 0), point_size=0.004 * SHOWN_DISTANCE, visible=False
        )

    def fly_to_photograph(self, name: str) -> None:
        """Move the camera to a photograph's in a short flight."""
        self._place(_key_frame_of(self.page.scene.cameras[name]), flight=True)

    def _key_frame(self) -> KeyFrame:
        """Where the camera is."""
        own = self.client.camera
        rotation = Rotation.from_quat(np.roll(own.wxyz, -1)).as_matrix()
        return KeyFrame(np.asarray(own.position, dtype=np.float64) / self.page.scale, rotation, own.fov)

    def _place(self, target: KeyFrame, flight: bool = False) -> None:
        """Put the camera somewhere, at once or in a short flight."""
        start = self._key_frame()
        turns = Slerp([0, 1], Rotation.from_matrix(np.stack([start.rotation, target.rotation])))
        for step in range(1, FLIGHT_STEPS + 1) if flight else (FLIGHT_STEPS,):
            share = step / FLIGHT_STEPS
            share = share * share * (3 - 2 * share)
            position = (1 - share) * start.position_world + share * target.position_world
            self._set_camera(position, turns(share).as_matrix(), (1 - share) * start.fov + share * target.fov)
            if step < FLIGHT_STEPS:
                time.sleep(FLIGHT_SECONDS / FLIGHT_STEPS)

    def _set_camera(self, position: Any, rotation: Any, fov: float) -> None:
        camera, client = self.client.camera, self.client
        with client.atomic():
            camera.up_direction = tuple(-rotation[:, 1])
            camera.position = tuple(self.page.scale * position)
            camera.look_at = tuple(self.page.scale * position + SHOWN_DISTANCE * rotation[:, 2])
            camera.fov = fov
        client.flush()

    def _show_address(self) -> None:
        own = self.client.camera

        def words(vector: Any) -> str:
            return ",".join(f"{value:.5f}" for value in vector)

        query = (
            f"?initialCameraPosition={words(own.position)}&initialCameraLookAt={words(own.look_at)}"
            f"&initialCameraUp={words(own.up_direction)}&initialCameraFov={own.fov:.5f}"
        )
        self.link.content = f"[This view]({query}): keep or send its address."


def _key_frame_of(camera: Cameras) -> KeyFrame:
    """Where a photograph's camera is."""
    return KeyFrame(
        camera.position_world[0].double().numpy(),
        camera.T_world_camera[0, :, :3].double().numpy(),
        2 * math.atan(camera.height / 2 / float(camera.focal_px[0, 1])),
    )
