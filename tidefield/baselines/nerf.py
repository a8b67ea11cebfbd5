"""Classical NeRF (Mildenhall et al., "NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis", ECCV
2020), the paper's "conventional NeRF": one multi-layer perceptron for a coarse and one for a fine pass along each ray.

Sizes and rates are the authors'. Where their code departs from their equations we follow the code, which made their
figures: positions enter next to their encoding, and frequencies go without the factor pi. Exposures are corrected as
for every other method here.

Alphabet: R rays, M samples of a ray, P points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.baselines.export import exposure_factor
from tidefield.config import USUAL_SAMPLING, NerfConfig, Sampling
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.compositing import composite, weights
from tidefield.model.rendering import Render, Rendering, with_rays
from tidefield.model.sampling import sample
from tidefield.parallel import check_interrupted
from tidefield.train.loop import Trainer

RAYS_AT_ONCE = 1024
"""When rendering: the widest layer's values of so many rays are some 200 MB."""


def encode(x: Float[Tensor, "*P 3"], octaves: int) -> Float[Tensor, "*P C"]:
    """x, sin(2^k x), cos(2^k x) for k = 0 .. octaves - 1 (eq. 4 of NeRF, as its code has it): 3 + 6 octaves values."""
    scaled = x[..., None, :] * 2.0 ** torch.arange(octaves, device=x.device)[:, None]
    return torch.cat([x, scaled.sin().flatten(-2), scaled.cos().flatten(-2)], dim=-1)


class Mlp(nn.Module):
    """Density and colour of a position seen in a direction (NeRF's Figure 7)."""

    def __init__(self, config: NerfConfig) -> None:
        super().__init__()
        position, direction = 3 + 6 * config.position_octaves, 3 + 6 * config.direction_octaves
        self.config, width = config, config.width
        self.skip = config.depth // 2 + 1
        inputs = [position] + [width + (position if k == self.skip else 0) for k in range(1, config.depth)]
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.branch = nn.Linear(width + direction, width // 2)
        self.colour = nn.Linear(width // 2, 3)

    def forward(
        self, xyz: Float[Tensor, "R M 3"], direction: Float[Tensor, "R 3"]
    ) -> tuple[Float[Tensor, "R M"], Float[Tensor, "R M 3"]]:
        """Densities before their ReLU, and colours in [0, 1]; positions in [-1, 1], directions of length 1."""
        position = encode(xyz, self.config.position_octaves)
        seen_from = encode(direction, self.config.direction_octaves)[:, None].expand(-1, xyz.shape[1], -1)
        x = position
        for k, layer in enumerate(self.trunk):
            x = F.relu(layer(torch.cat([position, x], dim=-1) if k == self.skip else x))
        density = self.density(x)[..., 0]
        colour = self.colour(F.relu(self.branch(torch.cat([self.feature(x), seen_from], dim=-1))))
        return density.float(), colour.float().sigmoid()


@dataclass(frozen=True)
class Rays:
    """Rays with the z-depths between which they may meet the scene; one unit of a direction is one of z-depth."""

    origin_world: Float[Tensor, "R 3"]
    direction_world: Float[Tensor, "R 3"]
    near_far: Float[Tensor, "R 2"]

    @staticmethod
    def of(cameras: Cameras, which: Int[Tensor, " R"], uv_px: Float[Tensor, "R 2"]) -> Rays:
        """Rays through pixels of some of the cameras."""
        chosen = cameras[which]
        return Rays(chosen.position_world, chosen.directions_world(uv_px[:, None])[:, 0], chosen.near_far)


@dataclass(frozen=True)
class Seen:
    """What one pass sees along rays, at the common exposure; what lies behind the scene is not in the colour."""

    colour: Float[Tensor, "R 3"]
    depth: Float[Tensor, " R"]
    opacity: Float[Tensor, " R"]
    weights: Float[Tensor, "R M"]


class Nerf(nn.Module):
    """The coarse and the fine network. The scene's place and exposure are set once by `cover`, stored with the weights.

    Colours of the networks, at most 1, divided by `headroom` are at the common exposure, where what a photograph of
    small gain shows is brighter than 1.
    """

    centre_world: Tensor
    radius: Tensor
    headroom: Tensor

    def __init__(self, config: NerfConfig) -> None:
        super().__init__()
        self.config = config
        self.coarse, self.fine = Mlp(config), Mlp(config)
        self.register_buffer("centre_world", torch.zeros(3))
        self.register_buffer("radius", torch.ones(()))
        self.register_buffer("headroom", torch.ones(3))

    def cover(self, cameras: Cameras) -> None:
        """Bring all that cameras may see into [-1, 1], and all that their photographs may show within reach."""
        corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        ends = cameras.directions_world(corners * cameras.size_px[:, None])
        points = cameras.position_world[:, None, None] + ends[:, :, None] * cameras.near_far[:, None, :, None]
        points = torch.cat([points.reshape(-1, 3), cameras.position_world])
        low, high = points.amin(0), points.amax(0)
        self.centre_world.copy_((low + high) / 2)
        self.radius.copy_((high - low).max() / 2)
        self.headroom.copy_(exposure_factor(cameras))

    def forward(
        self,
        rays: Rays,
        opaque: bool,
        generator: torch.Generator | None = None,
        precision: torch.dtype | None = None,
    ) -> tuple[Seen, Seen]:
        """What the coarse and the fine pass see.

        Args:
            opaque: whether the last sample stops all light: real scenes have no holes.
            generator: jitters samples and densities, for training.
            precision: of the layers; that of `choose_precision` if None.
        """
        config, count = self.config, len(rays.near_far)
        even = torch.ones(1, count, config.coarse, device=rays.near_far.device)
        place = _sample(even, config.coarse, generator)
        coarse = self._pass(self.coarse, rays, place, opaque, generator, precision)
        known = (coarse.weights.detach() + 1e-5)[None]
        finer = torch.cat([place, _sample(known, config.fine, generator)], dim=-1).sort(dim=-1).values
        return coarse, self._pass(self.fine, rays, finer, opaque, generator, precision)

    def _pass(
        self,
        mlp: Mlp,
        rays: Rays,
        place: Float[Tensor, "R M"],
        opaque: bool,
        generator: torch.Generator | None,
        precision: torch.dtype | None,
    ) -> Seen:
        near, far = rays.near_far[:, :1], rays.near_far[:, 1:]
        z = near + (far - near) * place
        xyz = rays.origin_world[:, None] + rays.direction_world[:, None] * z[..., None]
        length = rays.direction_world.norm(dim=-1, keepdim=True)
        with mixed_precision(z.device, precision):
            density, colour = mlp((xyz - self.centre_world) / self.radius, rays.direction_world / length)
        if generator is not None and opaque and self.config.density_noise:
            noise = torch.randn(density.shape, generator=generator).to(density)
            density = density + self.config.density_noise * noise
        last = torch.full_like(far, torch.inf) if opaque else far - z[:, -1:]
        delta = torch.cat([z.diff(dim=-1), last], dim=-1) * length / self.radius
        w = weights(F.relu(density), delta)
        return Seen(composite(w, colour) / self.headroom, (w * z).sum(-1), w.sum(-1), w)


def _sample(pdf: Float[Tensor, "1 R B"], count: int, generator: torch.Generator | None) -> Float[Tensor, "R M"]:
    jitter = None
    if generator is not None:
        jitter = torch.rand(1, pdf.shape[1], count, generator=generator).to(pdf)
    return sample(pdf, count, jitter)[0]


class NerfTrainer(Trainer):
    """Trains on rays through random pixels of all training photographs."""

    network: Nerf

    def __init__(self, config: NerfConfig, scene: Scene, seed: int, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Nerf(config)
        network.cover(scene.cameras[list(scene.train)])
        super().__init__(network.to(device), config.learning_rate, scene, seed, device, {})
        self.config, self.cameras = config, scene.cameras.to(device)

    @property
    def rays_per_step(self) -> int:
        return self.config.rays

    def rate(self, share: float) -> float:
        return 0.1**share

    def backward(self) -> Tensor:
        self.optimizer.zero_grad()
        loss, error = self.loss()
        loss.backward()
        return error

    def loss(self) -> tuple[Tensor, Tensor]:
        """Compute the squared errors of both passes (NeRF's eq. 6), and that of the fine one."""
        scene, device = self.scene, self.device
        which, uv, truth, gain = draw_pixels(scene, self.config.rays, self.generator)
        rays = Rays.of(self.cameras, which.to(device), uv.to(device))
        background, truth = scene.background_rgb, truth.to(device)
        errors = []
        for seen in self.network(rays, background is None, self.generator, self.precision):
            colour = seen.colour
            if background is not None:
                # The background has no exposure: rendering adds it to colours that the gain was applied to.
                behind = colour.new_tensor(background) / gain.to(device)
                colour = colour + (1 - seen.opacity[:, None]) * behind
            errors.append(F.mse_loss(colour, truth))
        return errors[0] + errors[1], errors[1].detach()

    def renderer(self, sampling: Sampling = USUAL_SAMPLING) -> Render:
        return with_rays(make_render(self.network, self.scene, self.device), sampling)


def draw_pixels(
    scene: Scene, count: int, generator: torch.Generator
) -> tuple[Int[Tensor, " R"], Float[Tensor, "R 2"], Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Random pixels of random training photographs: which, where, their colours at common exposure, and their gains.

    Those of them that are masked are left out.
    """
    train = torch.tensor(scene.train)
    which = train[torch.randint(len(train), (count,), generator=generator)]
    pixel = (torch.rand(count, 2, generator=generator) * scene.cameras.size_px[which]).floor()
    colour, gain, used = torch.empty(count, 3), torch.empty(count, 3), torch.ones(count, dtype=torch.bool)
    for index in which.unique().tolist():
        mine = which == index
        u, v = pixel[mine].long().unbind(-1)
        gain[mine] = scene.cameras[index].gain_at(pixel[None, mine] + 0.5)[0]
        colour[mine] = scene.photographs[index][v, u].float() / (255 * gain[mine])
        if scene.photographs.masks:
            used[mine] = scene.photographs.used(index)[v, u]
    return which[used], pixel[used] + 0.5, colour[used], gain[used]


def make_render(network: Nerf, scene: Scene, device: torch.device) -> Render:
    """A trained NeRF as a method for one scene."""

    @torch.inference_mode()
    def render(camera: Cameras) -> Rendering:
        here, parts = camera.to(device), []
        for uv in pixel_grid(camera.width, camera.height, device).split(RAYS_AT_ONCE):
            check_interrupted()
            rays = Rays.of(here, torch.zeros(len(uv), dtype=torch.long, device=device), uv)
            _, seen = network(rays, scene.background_rgb is None)
            # Expected where something is; in the middle where nothing is.
            depth = torch.where(seen.opacity > 0, seen.depth / seen.opacity, rays.near_far.mean(1))
            parts.append(torch.cat([seen.colour, depth[:, None], seen.opacity[:, None]], dim=-1).cpu())
        colour, depth, opacity = torch.cat(parts).reshape(camera.height, camera.width, 5).split([3, 1, 1], dim=-1)
        colour = colour * camera.gain_of_rows()
        if scene.background_rgb is not None:
            colour = colour + (1 - opacity) * torch.tensor(scene.background_rgb)
        return Rendering(colour.clamp(0, 1), depth[..., 0], opacity[..., 0].clamp(0, 1))

    return render
