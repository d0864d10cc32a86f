"""The outside world: a MetaDrive crossing with a corner building, the ego's camera, and vehicles on the main road.

Scene space is that of the dataset: metres, +Z up, the crossing at the origin, the main road along X. The ego drives up
the stem along +Y, and the others come from -X. Matrices and poses of this file are in scene space.
"""

import math
from typing import NamedTuple, Sequence

import numpy as np
from metadrive.component.buildings.base_building import BaseBuilding
from metadrive.component.pgblock.intersection import InterSection
from metadrive.component.vehicle.vehicle_type import XLVehicle
from metadrive.constants import CamMask
from metadrive.engine.asset_loader import AssetLoader
from metadrive.envs.metadrive_env import MetaDriveEnv
from metadrive.utils.scene_utils import generate_static_box_physics_body
from metadrive.utils.space import ConstantSpace, Parameter, ParameterSpace
from panda3d.core import LMatrix4f, TextureStage, Vec3

SIDE_PX = 128
FOV_DEG = 60.0
FOCAL_PX = SIDE_PX / 2 / math.tan(math.radians(FOV_DEG / 2))
FRAME_S = 0.1

# The crossing in MetaDrive's own space, which has y to the right.
CROSSING_X, CROSSING_Y = 55.75, -1.75
# Middle of the ego's lane, and of the lane of vehicles from the left.
EGO_X, LANE_Y = 1.75, -1.75
TRUCK_SIZE_M = (5.8, 2.3, 2.8)
# Where vehicles wait that an episode does not have, and the time until a vehicle rests on its wheels.
PARKED_X = -140.0
SETTLING_FRAMES = 30

# Smallest and largest x and y, height, colour. The first one hides the main road's left arm from the stem.
BUILDINGS = [
    ((-16.6, -14.4), (-4.7, -5.3), 4.8, (0.75, 0.42, 0.32)),
    ((6.5, -16.0), (15.0, -6.5), 4.0, (0.85, 0.78, 0.55)),
    ((-22.0, 7.0), (-9.0, 14.0), 3.6, (0.55, 0.65, 0.80)),
    ((-4.0, 9.0), (6.0, 16.0), 5.6, (0.80, 0.80, 0.76)),
]


class Road(NamedTuple):
    """Places on the ego's way: y of its centre."""

    start_y: float = -17.0
    stop_y: float = -6.75  # 1.6 m ahead of the others' lane
    clear_y: float = 3.3  # has left the lane, 1.6 m behind it


class Building(BaseBuilding):
    """A box with walls that stop vehicles."""

    MASS = 0
    HEIGHT = 0

    def __init__(self, lane, low, high, height_m, colour, random_seed=None):
        middle = [(low[i] + high[i]) / 2 for i in (0, 1)]
        super().__init__(lane, to_metadrive(*middle), 0.0, random_seed)
        along, across = high[1] - low[1], high[0] - low[0]
        self.add_body(generate_static_box_physics_body(along, across, height_m, object_id=self.id))
        self.set_position(to_metadrive(*middle), 0)
        model = self.loader.loadModel(AssetLoader.file_path("models", "box.bam"))
        model.setScale(along, across, height_m)
        model.setZ(height_m / 2)
        model.setColorScale(*colour, 1)
        texture = self.loader.loadTexture(AssetLoader.file_path("textures", "sidewalk", "color.png"))
        model.setTexture(TextureStage.getDefault(), texture, 1)
        model.reparentTo(self.origin)


def to_metadrive(x: float, y: float) -> tuple:
    """Returns a place of scene space in MetaDrive's space."""
    return (y + CROSSING_X, x + CROSSING_Y)


def look_at(eye: Sequence, target: Sequence, up: Sequence = (0, 0, 1)) -> np.ndarray:
    """Returns `world_from_camera` (x right, y up, z back) of a camera at `eye` that looks at `target`."""
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, eye
    return matrix


def roof_camera(y: float, left_deg: float, down_deg: float, height_m: float, forward_m: float) -> np.ndarray:
    """Returns `world_from_camera` of a level camera on the ego's roof, turned to the left."""
    left, down = math.radians(left_deg), math.radians(down_deg)
    eye = np.array([EGO_X, y + forward_m, height_m])
    ahead = [-math.sin(left) * math.cos(down), math.cos(left) * math.cos(down), -math.sin(down)]
    return look_at(eye, eye + ahead)


class World:
    """MetaDrive with one camera. Nothing in it is random."""

    def __init__(self, others: int) -> None:
        InterSection.EXIT_PART_LENGTH = 70
        spaces = {Parameter.radius: 4, Parameter.change_lane_num: 0, Parameter.decrease_increase: 0}
        InterSection.PARAMETER_SPACE = ParameterSpace({key: ConstantSpace(value) for key, value in spaces.items()})
        self.env = MetaDriveEnv(
            dict(
                map_config=dict(type="block_sequence", config="X", lane_num=1, lane_width=3.5),
                traffic_density=0.0,
                random_spawn_lane_index=False,
                image_observation=True,
                multi_thread_render=False,
                cull_scene=False,
                show_skybox=False,
                show_interface=False,
                show_fps=False,
                global_light=False,
                vehicle_config=dict(show_navi_mark=False, rgb_camera=(SIDE_PX, SIDE_PX)),
            )
        )
        self.buildings, self.others = [], [None] * others
        self._build()
        # A camera on the roof does not see its vehicle, and no state of the dataset has it.
        self.ego.origin.hide(CamMask.RgbCam)
        self.heights_m = {vehicle: vehicle.origin.getZ() for vehicle in [self.ego, *self.others]}

    def _build(self) -> None:
        """Builds the crossing, its buildings and the vehicles, and lets the vehicles settle on their wheels."""
        # MetaDrive draws the heights of overlapping lanes from this stream: the image depends on them.
        np.random.seed(0)
        self.env.reset()
        engine, self.ego = self.env.engine, self.env.vehicle
        engine.world_light.direction_np.node().setShadowCaster(False)
        lane = self.env.current_map.road_network.get_lane((">", ">>", 0))
        for low, high, height_m, colour in BUILDINGS:
            shape = dict(low=low, high=high, height_m=height_m, colour=colour)
            self.buildings.append(engine.spawn_object(Building, pbr_model=False, lane=lane, random_seed=0, **shape))
        for number in range(len(self.others)):
            config = dict(show_navi_mark=False, show_dest_mark=False, need_navigation=False)
            config["spawn_position_heading"] = (to_metadrive(PARKED_X - 10 * number, LANE_Y), 90.0)
            self.others[number] = engine.spawn_object(XLVehicle, vehicle_config=config, random_seed=0)
        self._aim()
        for _ in range(SETTLING_FRAMES):
            self.env.step([0.0, -1.0])

    def _aim(self) -> None:
        """Takes MetaDrive's camera from the ego, and puts it into scene space."""
        engine = self.env.engine
        self.sensor = self.ego.image_sensors["rgb_camera"]
        self.scene = engine.render.attachNewNode("scene")
        self.scene.setPos(CROSSING_X, -CROSSING_Y, 0)
        self.scene.setH(-90)
        self.sensor.cam.reparentTo(self.scene)
        self.sensor.lens.setAspectRatio(1.0)
        self.sensor.lens.setFov(FOV_DEG)
        self.sensor.lens.setNearFar(0.1, 500.0)
        # Nothing is rendered while MetaDrive steps, and only the camera's buffers in `image`.
        engine.win.setActive(False)
        self.buffers = [self.sensor.buffer, *self.sensor.manager.buffers]
        self._render(False)
        # In software, an anisotropic filter takes up to seconds for a view of the horizon.
        for texture in engine.render.findAllTextures():
            texture.setAnisotropicDegree(1)

    def _render(self, is_on: bool) -> None:
        for buffer in self.buffers:
            buffer.setActive(is_on)

    def image(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Renders the scene from a pose: (height, width, RGB)."""
        right, up, back, eye = (world_from_camera[:3, i] for i in range(4))
        # Panda3D's camera looks along +Y, with +Z up.
        self.sensor.cam.setMat(LMatrix4f(*right, 0, *-back, 0, *up, 0, *eye, 1))
        self._render(True)
        self.env.engine.graphicsEngine.renderFrame()
        shot = self.sensor.buffer.getDisplayRegion(1).getScreenshot()
        pixels = np.frombuffer(shot.getRamImage().getData(), np.uint8).reshape(SIDE_PX, SIDE_PX, -1)
        self._render(False)
        return np.ascontiguousarray(pixels[::-1, :, 2::-1])

    def put(self, vehicle, x: float, y: float, heading_deg: float, speed_mps: float) -> None:
        """Puts a vehicle at a place and in motion; a heading of 0 is along +X."""
        vehicle.set_position(to_metadrive(x, y), self.heights_m[vehicle])
        # A vehicle's nose is along its +Y.
        vehicle.origin.setHpr(self.scene, heading_deg - 90.0, 0, 0)
        heading = math.radians(heading_deg)
        vehicle.set_velocity((math.sin(heading), math.cos(heading)), speed_mps)
        vehicle.body.setAngularVelocity(Vec3(0, 0, 0))

    def put_ego(self, y: float, speed_mps: float) -> None:
        """Puts the ego onto its lane."""
        self.put(self.ego, EGO_X, y, 90.0, speed_mps)

    def put_other(self, number: int, x: float, speed_mps: float = 0.0) -> None:
        """Puts another vehicle onto the lane that the ego crosses."""
        self.put(self.others[number], x, LANE_Y, 0.0, speed_mps)

    def park(self) -> None:
        """Puts the other vehicles where no camera of the ego sees them."""
        for number in range(len(self.others)):
            self.put_other(number, PARKED_X - 10 * number)

    def place(self, vehicle) -> tuple:
        """Returns a vehicle's x, y, z."""
        return tuple(vehicle.origin.getPos(self.scene))
