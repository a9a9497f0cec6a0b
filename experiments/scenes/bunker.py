"""The bunker: concrete corridors, a machine hall and a pump room, after the UE4 "Bunker" of the papers.

Every (seed, split, clip) places machines, crates, pipes and lamps anew on one floor plan and takes one shot
of it; training and test shots walk different halves of each place. One lamp changes its colour at random on
every frame (white, yellow, blue, red) and shines on pipes: history shows colours that the current frame does
not have.

    corridor  x -1.9..1.9, y -24..0, with a side corridor west at its south end (the L-turn)
    hall      x -8..8,     y 0..26,  6.5 m high: columns, crane, fan, robot arm, gallery, store
    pumps     x -22..-8,   y 6..18,  5 m high: tanks, pumps with flywheels, pistons, manifolds

Here: settings, camera walks and `build`. Rooms: bunker_places.py, bunker_parts.py, bunker_machines.py;
materials and the mesh builder: bunker_kit.py.
"""

import math
import random
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
from mathutils import Matrix

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co
from bunker_kit import library
from bunker_parts import Place
from bunker_places import corridor, hall, pumps, shell

SETTINGS = {
    "test_samples": 64,
    "train_samples": 16,
    "denoise": True,
    "max_bounces": 1,
    "diffuse_bounces": 0,
    "glossy_bounces": 1,
    "exposure": 1.35,
}

FLICKER = ((1.0, 0.96, 0.90), (1.0, 0.72, 0.10), (0.12, 0.28, 1.0), (1.0, 0.07, 0.04))
SHOTS = ("corridor", "pumps", "hall", "turn", "gallery", "store")


@dataclass
class Walk:
    """A hand-held walk: start, heading and turns in degrees (0 looks along +y, positive turns left)."""

    start: tuple[float, float, float]
    heading: float
    speed: float
    turn: float = 0.0
    look: float = 0.0
    look_rate: float = 0.0
    pitch: float = -3.0
    phase: float = 0.0

    def matrix(self, frame: int) -> Matrix:
        """Camera matrix at a frame."""
        x, y, z = self.start
        for step in range(frame):
            angle = math.radians(self.heading + self.turn * step)
            x, y = x - math.sin(angle) * self.speed, y + math.cos(angle) * self.speed
        z += 0.018 * math.sin(0.55 * frame + self.phase)
        view = math.radians(self.heading + self.turn * frame + self.look + self.look_rate * frame)
        view += math.radians(0.25) * math.sin(0.8 * frame + 2 * self.phase)
        pitch = math.radians(self.pitch + 0.5 * math.sin(0.42 * frame + self.phase))
        target = (x - math.sin(view), y + math.cos(view), z + math.tan(pitch))
        return co.look_at((x, y, z), target, roll=math.radians(0.5) * math.sin(0.37 * frame + self.phase))


def shot(kind: str, split: str, rng: random.Random) -> Walk:
    """The walk of a shot; training and test take different halves of the place and other directions."""
    test = split == "test"
    jitter, phase = rng.uniform(-1, 1), rng.uniform(0, math.tau)
    side = rng.choice((-1, 1))
    if kind == "corridor":
        y = rng.uniform(-11.5, -9.5) if test else rng.uniform(-19.5, -14.0)
        speed = rng.uniform(0.07, 0.10)
        start, heading, look = (0.45 * jitter, y, 1.62), 2 * jitter, 9 * side
        return Walk(start, heading, speed, look=look, look_rate=-0.75 * side, pitch=-4, phase=phase)
    if kind == "pumps":
        speed = rng.uniform(0.06, 0.08)
        if test:
            start = (-17.8 + jitter, 9.1, 1.6)
            return Walk(start, -92, speed, look=58, look_rate=0.45, pitch=-1, phase=phase)
        start, look = (-11.5 + 1.2 * jitter, 9.4, 1.6), -52 - 6 * jitter
        return Walk(start, 90, speed, look=look, look_rate=0.5 * side, pitch=-1, phase=phase)
    if kind == "hall":
        if test:
            start, speed = (1.6 + 0.5 * jitter, 23.0, 1.7), rng.uniform(0.08, 0.11)
            return Walk(start, 172, speed, -0.3, look=14, look_rate=0.4 * side, pitch=3, phase=phase)
        start, speed = (0.6 + 0.5 * jitter, rng.uniform(1.5, 3.5), 1.7), rng.uniform(0.08, 0.11)
        return Walk(start, 0, speed, look=10 * side, look_rate=-0.6 * side, pitch=3, phase=phase)
    if kind == "turn":
        if test:
            start, look = (-8.0 + jitter, -22.1, 1.6), 6 * side
            return Walk(start, -90, 0.09, look=look, look_rate=-0.7 * side, pitch=-3, phase=phase)
        start = (-2.3 + 0.2 * jitter, -22.4, 1.6)
        return Walk(start, -70, 0.09, 1.1, look=32, look_rate=0.75, pitch=-4, phase=phase)
    if kind == "gallery":
        if test:
            start = (5.9, 21.5 + jitter, 4.9)
            return Walk(start, 180, 0.07, look=-46, look_rate=-0.5, pitch=-17, phase=phase)
        start, look = (5.9, 4.5 + jitter, 4.9), 44 + 5 * jitter
        return Walk(start, 0, 0.07, look=look, look_rate=0.5, pitch=-17, phase=phase)
    rate = 0.55 * side
    if test:
        return Walk((1.5, 15.5 + jitter, 1.6), 10, 0.075, look=-62, look_rate=rate, pitch=-2, phase=phase)
    return Walk((1.2, 5.0 + jitter, 1.6), 0, 0.075, look=-58, look_rate=rate, pitch=-2, phase=phase)


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    """Build the bunker of one clip into an emptied file; frames 0..frames+1 are keyed."""
    rng = co.generator("bunker", seed, split, clip)
    kind = SHOTS[clip % len(SHOTS)]
    walk = shot(kind, split, rng)
    camera = co.camera(fov_deg=74.0, near=0.05, far=120.0)
    camera.name = f"camera_{kind}"
    matrices = [walk.matrix(frame) for frame in range(frames + 2)]
    co.key_matrices(camera, matrices)
    co.sky([(-1.0, (0.01, 0.01, 0.012)), (1.0, (0.02, 0.02, 0.024))], 1.0)

    previous, colors = -1, []
    for _ in range(frames + 2):
        choice = rng.choice([i for i in range(len(FLICKER)) if i != previous])
        colors.append(FLICKER[choice])
        previous = choice
    stains = co.generator("bunker stains", seed, split, clip)
    shift = [0.0 if split == "test" else stains.uniform(20, 200) for _ in range(3)]
    place = Place(library(shift), rng, [matrix.translation for matrix in matrices], frames)
    shell(place)
    corridor(place, colors, lit=kind in ("corridor", "turn"))
    hall(
        place, colors, lit={"corridor": "door", "hall": "all", "gallery": "all", "store": "all"}.get(kind, "")
    )
    pumps(place, colors, lit=kind == "pumps")
    bpy.context.view_layer.update()
