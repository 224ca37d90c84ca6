"""A list of operations with its tensors, executed by PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import ops
from mbtf_fit.ops.constants import DIELECTRIC, FIBERS, HEIGHTS, HINTS, HORIZONS, LIGHT_WIDTH, MAPS
from mbtf_fit.ops.operation import needed_for, output_names, parse, reached_from, sizes_of
from mbtf_fit.ops.value import calibrated
from mbtf_fit.pytorch.networks import InceptionDecoder, Mlp, initialize_layers
from mbtf_fit.pytorch.operations import FUNCTIONS, PYTORCH, Execution, displacement
from mbtf_fit.pytorch.textures import FeatureTextures
from mbtf_fit.pytorch.values import aligned, read_value, shaped
from mbtf_fit.surface.hints import compute_hints
from mbtf_fit.surface.known import KnownSurface

# Standard deviation of the initial features; weight of the traced displacement before training.
FEATURE_SCALE, FIRST_WEIGHT = 0.1, 0.9
# Operations that read the surface.
_SURFACE = (ops.Trace, ops.Shade, ops.SurfaceMaps, ops.FiberFrame)
# Tensor of the calibration factors.
CALIBRATION = "calibration"
# Bound of learned values that have none, in units.
UNBOUNDED = 1e30


class NeuralMaterial(nn.Module):
    """A function M(u, σ, ω_i, ω_o), given as a list of operations.

    Parameters
    ----------
    lattice : texel grids of the tile
    operations : the list
    name : of the model, for messages

    Attributes
    ----------
    surface : heights and maps that rays are traced to, where the list has such operations; set by
        :meth:`know` or :meth:`load_weights`
    calibration : factors (2, levels, knots, 3) by elevation of light and of view
        (:mod:`mbtf_fit.training.calibration`); None without calibration
    """

    calibration: Tensor | None

    def __init__(self, lattice: Lattice, operations: Sequence[ops.Operation], name: str = "") -> None:
        super().__init__()
        self.lattice, self.name = lattice, name
        self.surface: KnownSurface | None = None
        # Without calibration factors.
        whole, operations = [*operations], [*operations][:-3]
        operations = operations if operations and calibrated(operations) == whole else whole
        self._own = operations
        self._plans: dict[tuple[tuple[str, ...], frozenset[str]], list[ops.Operation]] = {}
        self._learned: set[str] = set()
        sizes = sizes_of(operations)
        PYTORCH.check(operations)
        _check_surface(operations)
        moving = {r for o in operations if isinstance(o, ops.Offset) for r in _behind(operations, o.r)}
        for op in reversed(operations):
            self._create(op, sizes, moves=op.output in moving)
        bounds = self.bounds
        for tensor in _scalars(operations):
            self.register_buffer(tensor, torch.full((), UNBOUNDED if tensor in bounds else 1.0))
        self.register_buffer(CALIBRATION, None)

    def _create(self, op: ops.Operation, sizes: Mapping[str, int], *, moves: bool) -> None:
        """Create the parameters of an operation."""
        lattice = self.lattice
        if isinstance(op, ops.Lookup):
            finer = op.oversampling.bit_length() - 1
            grids = Lattice(lattice.finest + finer, lattice.aspect)
            levels = [grids.finest] if op.level is None else range(finer, grids.finest + 1)
            textures = FeatureTextures(grids, levels, op.channels, moves_lookups=moves)
            self.add_module(op.textures, textures)
        elif isinstance(op, ops.Network):
            inputs = sum(_size(r, sizes) for r in op.x)
            self.add_module(op.weights, Mlp(op.widths(inputs), op.activation))
        elif isinstance(op, ops.Inception):
            features, shared = (sum(_size(r, sizes) for r in part) for part in (op.features, op.shared))
            layers = op.width, op.modules, op.outputs, op.activation
            self.add_module(op.weights, InceptionDecoder(features, shared, *layers))
        elif isinstance(op, ops.Displace):
            weights = torch.full((lattice.finest + 1,), FIRST_WEIGHT)
            self.register_parameter(op.weights, nn.Parameter(weights))
            if op.learned is not None:
                self._learned.add(op.learned)
                self.add_module(op.learned, FeatureTextures(lattice, [lattice.finest], 1, moves_lookups=True))

    @property
    def operations(self) -> list[ops.Operation]:
        """The whole list."""
        return self._own if self.calibration is None else calibrated(self._own)

    def calibrate(self, factors: Tensor | None) -> None:
        """Set the calibration factors."""
        self._buffers[CALIBRATION] = factors
        self._plans.clear()

    def initialize(self, generator: torch.Generator, unit: float, most: float = UNBOUNDED) -> None:
        """Initialize all parameters at random: textures that move no lookups, then the networks, the last one
        first.

        `unit` is a typical value of the data in 1/sr. Values are multiples of it, so that black data (0) are
        fitted exactly. What is learned of them is bounded by `most` units.
        """
        for textures in self.textures():
            if textures.moves_lookups:
                nn.init.zeros_(textures.texels)
            else:
                nn.init.normal_(textures.texels, std=FEATURE_SCALE, generator=generator)
        starts = _first_outputs(self._own)
        for name, network in self.networks().items():
            initialize_layers(network, generator)
            *_, last_bias = network.parameters()
            for index, start in starts.get(name, {}).items():
                last_bias.data[index] = start
        bounds = self.bounds
        for tensor in _scalars(self._own):
            self.number(tensor).fill_(most if tensor in bounds else unit)

    def run(
        self, wanted: Sequence[str], given: Mapping[str, Tensor], grid: tuple[int, int] | None = None
    ) -> list[Tensor]:
        """Values by name, from given ones (n, size); levels are (n,).

        Parameters
        ----------
        grid : rows and columns of the positions of each query, where these are given
        """
        key = tuple(wanted), frozenset(given)
        if key not in self._plans:
            self._plans[key] = needed_for(self.operations, wanted, [*given])
        values = self.execute(self._plans[key], given, grid)
        return [values[name] for name in wanted]

    def execute(
        self,
        operations: Sequence[ops.Operation],
        given: Mapping[str, Tensor],
        grid: tuple[int, int] | None = None,
    ) -> dict[str, Tensor]:
        """The given values, and those of some operations."""
        run, values = Execution(self, grid), dict(given)
        for op in operations:
            read = op.arguments(lambda name, part: read_value(values, name, part))
            arguments: list[object] = [*map(shaped, op.value_fields(), read)]
            if not isinstance(op, ops.Inception):
                arguments = aligned(arguments)
            found = PYTORCH[op](op, run, *arguments)
            found = (found,) if isinstance(found, Tensor) else found
            values.update(zip(output_names(op), found, strict=True))
        return values

    def forward(
        self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor, hints: Tensor | None = None
    ) -> Tensor:
        """Value (n, 3) in 1/sr, not clamped; `hints` of a surface are computed where they are not given."""
        given = self._given(u, sigma, omega_i, omega_o)
        if self.tracing is not None:
            trace, shade = self.tracing
            hints = self.hints(u, sigma, omega_i, omega_o) if hints is None else hints
            given |= {trace.output: hints[:, :1], shade.output: hints[:, 1:HINTS]}
            if self.fiber_frame is not None:
                given[self.fiber_frame.output] = hints[:, HINTS:]
        return self.run([self.operations[-1].output], given)[0]

    def evaluate_patches(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Values (items, rows, columns, 3) at positions (items, rows+2·margin, columns+2·margin, 2) that
        share footprint (items,), light and view (items, 3)."""
        rows, columns = u.shape[1:3]
        given = self._given(u[:, 0, 0], sigma, omega_i, omega_o)
        given[self._grid.output if self._grid is not None else "u"] = u.reshape(-1, 2)
        (value,) = self.run([self.operations[-1].output], given, (rows, columns))
        return value.view(len(u), rows - 2 * self.margin, columns - 2 * self.margin, 3)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> dict[str, Tensor]:
        """Values of stage 1 by name, which do not depend on the light."""
        given = {"u": u, "level": self.level(sigma), "omega_o": omega_o}
        first, second = ops.stages(self.operations)
        read = {parse(reference)[0] for op in second for reference in op.inputs()}
        names = [name for op in first for name in output_names(op) if name in read]
        return given | dict(zip(names, self.run(names, given), strict=True))

    def stage2(self, values: Mapping[str, Tensor], omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Value (n, 3) in 1/sr of values of stage 1, for light from `omega_i` (n, 3)."""
        given = {**values, "omega_i": omega_i, "omega_o": omega_o}
        return self.run([self.operations[-1].output], given)[0]

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        """Displacement of the lookup at the finest footprint, (n, 2) in tile widths: the neural offset, or
        that of the surface point that is seen; zero for a model without, or where it depends on the light."""
        if any(isinstance(op, ops.Trace) for op in self._own):
            height = self.known.tracer.trace(u, omega_o)[:, None]
            return height * omega_o[:, :2] / omega_o[:, 2:]
        first, _ = ops.stages(self._own)
        op = next((o for o in first if isinstance(o, ops.Offset)), None)
        if op is None:
            return torch.zeros_like(u)
        level = u.new_full((len(u),), float(self.lattice.finest))
        given = {"u": u, "level": level, "omega_o": omega_o, op.u: u}
        return displacement(op, self.run([op.r], given)[0], omega_o)

    def level(self, sigma: Tensor) -> Tensor:
        """Fractional level ``-log2(2σ)`` of footprints, clamped to the lattice's levels."""
        return -torch.log2(2.0 * sigma).clamp(-float(self.lattice.finest), 0.0)

    def _given(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> dict[str, Tensor]:
        return {"u": u, "level": self.level(sigma), "omega_i": omega_i, "omega_o": omega_o}

    @property
    def _grid(self) -> ops.Neighborhood | None:
        return next((op for op in self._own if isinstance(op, ops.Neighborhood)), None)

    @property
    def margin(self) -> int:
        """Radius of the neighborhood that the value depends on, in texels of the nearest level."""
        return 0 if self._grid is None else self._grid.margin

    @property
    def positions(self) -> int:
        """Positions at which the textures are read for one query."""
        return (2 * self.margin + 1) ** 2

    @property
    def tracing(self) -> tuple[ops.Trace, ops.Shade] | None:
        """The operations that trace a surface and shade it, if there are any."""
        trace = next((op for op in self._own if isinstance(op, ops.Trace)), None)
        shade = next((op for op in self._own if isinstance(op, ops.Shade)), None)
        return None if trace is None or shade is None else (trace, shade)

    @property
    def rays(self) -> int:
        """Rays that are traced for one value."""
        if self.tracing is None:
            return 0
        return len(self.tracing[0].places) * (1 if self.tracing[1].heights is None else 2)

    @property
    def fiber_frame(self) -> ops.FiberFrame | None:
        """The operation that reads the fibers of the surface, if there is one."""
        return next((op for op in self._own if isinstance(op, ops.FiberFrame)), None)

    def know(self, surface: KnownSurface) -> None:
        """Set heights and maps of the surface, without what no lookup reaches."""
        finer = self.tracing is not None and self.tracing[1].finer > 0
        levels = self.lattice.finest + 1 + finer
        fibers = () if self.fiber_frame is None else surface.fibers[:levels]
        reached = len(surface.maps) == levels and len(surface.fibers) == len(fibers)
        self.surface = surface if reached else replace(surface, maps=surface.maps[:levels], fibers=fibers)

    @property
    def known(self) -> KnownSurface:
        """Heights and maps of the surface."""
        assert self.surface is not None, "the material has no surface yet"
        return self.surface

    def hints(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Height and shading (n, 7) of the surface that queries see, and directions about its fibers (n, 6)
        where they are read."""
        assert self.tracing is not None
        with torch.no_grad():
            return compute_hints(self.known, *self.tracing, self.fiber_frame, u, sigma, omega_i, omega_o)

    @property
    def bounds(self) -> set[str]:
        """Tensors () that bound learned values."""
        return {op.most for op in self._own if isinstance(op, ops.Transform) and op.most is not None}

    def texture(self, name: str) -> FeatureTextures:
        """Learned textures by name."""
        found = self._modules[name]
        assert isinstance(found, FeatureTextures)
        return found

    def number(self, name: str) -> Tensor:
        """A parameter or buffer by name."""
        found = self._parameters[name] if name in self._parameters else self._buffers[name]
        assert found is not None
        return found

    def textures(self) -> list[FeatureTextures]:
        """The learned textures; those that move lookups last."""
        found = [module for module in self.children() if isinstance(module, FeatureTextures)]
        return sorted(found, key=lambda textures: textures.moves_lookups)

    def stored_textures(self) -> dict[str, FeatureTextures]:
        """Textures that a material stores, by name."""
        found = self.named_children()
        return {n: m for n, m in found if isinstance(m, FeatureTextures) and n not in self._learned}

    def parameter_groups(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """(texels, network weights)."""
        return [texture.texels for texture in self.textures()], [*self._layers().values()]

    def spatial_weights(self) -> list[Tensor]:
        """Parts of the networks' first matrices that multiply what depends on the position, such as features
        and hints, where they are trained."""
        sizes, networks, out = sizes_of(self._own), self.networks(), []
        spatial = reached_from(self._own, "u")
        for op in self._own:
            if not isinstance(op, ops.Network | ops.Inception):
                continue
            first, start = next(networks[op.weights].parameters()), 0
            for reference in op.x if isinstance(op, ops.Network) else (*op.features, *op.shared):
                stop = start + _size(reference, sizes)
                if parse(reference)[0] in spatial and first.requires_grad:
                    out.append(first[:, start:stop])
                start = stop
        return out

    def networks(self) -> dict[str, nn.Module]:
        """Networks by name, the last one first: materials can share them."""
        return {n: module for n, module in self.named_children() if not isinstance(module, FeatureTextures)}

    def share_networks(self, other: NeuralMaterial) -> None:
        """Use the networks of another material with the same operations in place of its own ones."""
        for name, module in other.networks().items():
            setattr(self, name, module)

    def freeze(self) -> None:
        """Exclude the networks from training."""
        for module in self.networks().values():
            module.requires_grad_(False)

    @property
    def frozen(self) -> bool:
        """Whether the networks are excluded from training."""
        return not any(p.requires_grad for module in self.networks().values() for p in module.parameters())

    def _layers(self) -> dict[str, nn.Parameter]:
        """Network weights by their names in a material."""
        return {
            name.replace("modules_.", ""): p
            for name, p in self.named_parameters()
            if not name.endswith(".texels")
        }

    def stored_operations(self) -> list[ops.Operation]:
        """The operations as a material stores them."""
        return [op.stored() for op in self.operations]

    def empty_copy(self) -> NeuralMaterial:
        """A material with the same operations as a material stores them, not initialized, for evaluation."""
        return NeuralMaterial(self.lattice, [op.stored() for op in self._own], self.name).requires_grad_(
            False
        )

    def weights(self) -> dict[str, Tensor]:
        """All tensors by name, with the current blur: one tensor (rows, columns, channels) per level of a
        texture; network layers as ``NAME.0.weight`` (outputs, inputs) and ``NAME.0.bias``, convolutions as
        ``NAME.weight`` (outputs, inputs, rows, columns)."""
        textures = {
            f"{name}.{level}": tensor
            for name, module in self.stored_textures().items()
            for level, tensor in module.export().items()
        }
        others = {**dict(self.named_buffers()), **self._layers()}
        surface = {} if self.surface is None else self.surface.tensors()
        return textures | {name: tensor.detach().clone() for name, tensor in others.items()} | surface

    def load_weights(self, tensors: Mapping[str, Tensor]) -> None:
        """Load tensors of :meth:`weights`.

        Raises
        ------
        InputError : a tensor is missing, unknown or of another shape
        """
        if any(isinstance(op, _SURFACE) for op in self._own):
            known = {name: tensor for name, tensor in tensors.items() if name.startswith("surface.")}
            try:
                self.surface = KnownSurface.from_tensors(known, self.lattice)
            except (KeyError, ValueError) as error:
                raise self._unfit(str(error)) from None
            if self.fiber_frame is not None and not self.surface.fibers:
                raise self._unfit(f"'{FIBERS}.0'")
        calibration = tensors.get(CALIBRATION)
        if calibration is not None:
            # Of any number of knots.
            shape = (2, self.lattice.finest + 1, calibration.shape[2] if calibration.ndim == 4 else 0, 3)
            if calibration.shape != shape or shape[2] < 2:
                raise self._unfit(f"'{CALIBRATION}'")
        self.calibrate(None if calibration is None else calibration.float().clone())
        mine = self.weights()
        for name in sorted({*mine, *tensors}):
            if name not in tensors or name not in mine or tensors[name].shape != mine[name].shape:
                raise self._unfit(f"'{name}'")
        with torch.no_grad():
            for name, tensor in (*self.named_buffers(), *self._layers().items()):
                tensor.copy_(tensors[name])
            for name, module in self.stored_textures().items():
                module.load({k.removeprefix(f"{name}."): t for k, t in tensors.items()})

    def _unfit(self, what: str) -> InputError:
        return InputError(f"the weights do not fit the model {self.name}: {what}")


def _size(reference: str, sizes: Mapping[str, int]) -> int:
    name, part = parse(reference)
    return len(range(sizes[name])[part])


def _behind(operations: Sequence[ops.Operation], reference: str) -> set[str]:
    """Values that a value is computed from."""
    return {op.output for op in needed_for(operations, [parse(reference)[0]], [])}


def _check_surface(operations: Sequence[ops.Operation]) -> None:
    """A material has one surface, whose tensors have fixed names."""
    surface = {HEIGHTS, MAPS, HORIZONS, LIGHT_WIDTH, DIELECTRIC, FIBERS}
    for op in operations:
        other = {*op.named("tensor"), *op.named("texture")} - surface if isinstance(op, _SURFACE) else None
        if other:
            raise ValueError(
                f"{op.kind()} '{op.output}' reads '{min(other)}', which is not of the surface: "
                + ", ".join(sorted(surface))
            )


def _scalars(operations: Sequence[ops.Operation]) -> list[str]:
    """Tensors () of a list: units of values, and their bounds."""
    named = {
        name for op in operations if isinstance(op, ops.Transform | ops.Gate) for name in op.named("tensor")
    }
    return sorted(named)


def _first_outputs(operations: Sequence[ops.Operation]) -> dict[str, dict[int, float]]:
    """Network → number → what it starts from, so that values start at the unit (at 0 for expm1)."""
    by_output = {op.output: op for op in operations}
    out: dict[str, dict[int, float]] = {}
    for op in operations:
        if isinstance(op, ops.Transform) and op.factor is not None:
            start, (name, part) = FUNCTIONS[op.function][1], parse(op.x)
            source, count = by_output.get(name), 3
            if isinstance(source, ops.Matrix):
                # Luma: the first of YUV.
                name, part = parse(source.x)
                source, count = by_output.get(name), 1
            if isinstance(source, ops.Network | ops.Inception):
                first = part.start or 0
                out[source.weights] = {first + k: start for k in range(count)}
    return out
