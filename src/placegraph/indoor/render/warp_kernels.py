"""The loops of `render_kernels` for NVIDIA Warp: the same equations, a thread a pixel."""

import warp as wp

from placegraph.indoor.rays.warp_kernels import Surface
from placegraph.indoor.render import render_kernels, shade_kernels

FARTHEST = wp.constant(wp.float32(3.0e38))
WIDEST = wp.constant(wp.float32(shade_kernels.WIDEST))
MOST_LOOKS = wp.constant(wp.float32(shade_kernels.MOST_LOOKS))
SHARP = wp.constant(wp.float32(shade_kernels.SHARP))
CONTRAST = wp.constant(render_kernels.CONTRAST)
CREASE = wp.constant(wp.float32(render_kernels.CREASE))
JUMP = wp.constant(wp.float32(render_kernels.JUMP))


@wp.struct
class World:
    """`render_kernels.World`; `mesh` is Warp's."""

    mesh: wp.uint64
    surface: Surface
    vertices: wp.array(dtype=wp.vec3)
    coloured: int


@wp.struct
class Eye:
    """`render_kernels.Eye`."""

    rays: wp.array2d(dtype=wp.vec2)
    turn: wp.mat33
    origin: wp.vec3


@wp.struct
class Picture:
    """`render_kernels.Picture`."""

    colour: wp.array3d(dtype=wp.uint8)
    depth: wp.array2d(dtype=wp.float32)
    objects: wp.array2d(dtype=wp.int32)
    triangles: wp.array2d(dtype=wp.int32)
    points: wp.array2d(dtype=wp.vec3)


@wp.func
def step_right(rays: wp.array2d(dtype=wp.vec2), row: int, column: int) -> wp.vec2:
    """How a ray changes from one pixel of a row to the next (`steps`)."""
    right = wp.min(column + 1, rays.shape[1] - 1)
    return rays[row, right] - rays[row, wp.max(right - 1, 0)]


@wp.func
def step_down(rays: wp.array2d(dtype=wp.vec2), row: int, column: int) -> wp.vec2:
    """How a ray changes from one pixel of a column to the next (`steps`)."""
    down = wp.min(row + 1, rays.shape[0] - 1)
    return rays[down, column] - rays[wp.max(down - 1, 0), column]


@wp.func
def direction(eye: Eye, ray: wp.vec2) -> wp.vec3:
    """The ray (x, y, 1) of the camera in map axes."""
    return eye.turn * wp.vec3(ray[0], ray[1], 1.0)


@wp.func
def looks(longer2: float, shorter2: float, deepest: int) -> wp.vec3:
    """`render_kernels.looks`: looks, level, part of the next."""
    longer = wp.sqrt(WIDEST)
    if longer2 < WIDEST:
        longer = wp.sqrt(longer2)
    if longer <= SHARP:
        return wp.vec3(1.0, 0.0, 0.0)
    shorter = wp.sqrt(WIDEST)
    if shorter2 < WIDEST:
        shorter = wp.sqrt(wp.max(shorter2, 1.0))
    taps = wp.max(wp.min(wp.ceil(longer / shorter - 0.25), MOST_LOOKS), 1.0)
    fine = wp.max(wp.log2(longer / taps), 0.0)
    level = wp.min(wp.floor(fine), float(deepest))
    part = fine - level
    if part < 0.05 or int(level) == deepest:
        part = float(0.0)
    return wp.vec3(taps, level, part)


@wp.func
def between(surface: Surface, texture: int, level: int, st: wp.vec2) -> wp.vec3:
    """Colour (0 to 255) between the four texels of a level around `st`."""
    start = surface.levels[texture, level, 0]
    columns = surface.levels[texture, level, 1]
    rows = surface.levels[texture, level, 2]
    x = (st[0] - wp.floor(st[0])) * float(columns) - 0.5
    y = (st[1] - wp.floor(st[1])) * float(rows) - 0.5
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    x = x - float(left)
    y = y - float(top)
    right = left + 1
    if right >= columns:
        right = int(0)
    bottom = top + 1
    if bottom >= rows:
        bottom = int(0)
    if left < 0:
        left = columns - 1
    if top < 0:
        top = rows - 1
    colour = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        a = float(surface.texels[start + top * columns + left, k])
        b = float(surface.texels[start + top * columns + right, k])
        c = float(surface.texels[start + bottom * columns + left, k])
        d = float(surface.texels[start + bottom * columns + right, k])
        colour[k] = (1.0 - y) * ((1.0 - x) * a + x * b) + y * ((1.0 - x) * c + x * d)
    return colour


@wp.func
def uv_step(surface: Surface, a: int, b: int) -> wp.vec2:
    """From one corner's texture coordinates to another's."""
    return wp.vec2(surface.uv[b, 0] - surface.uv[a, 0], surface.uv[b, 1] - surface.uv[a, 1])


@wp.func
def steps(
    world: World,
    eye: Eye,
    along: wp.vec3,
    a: int,
    b: int,
    c: int,
    far: float,
    row: int,
    column: int,
) -> wp.vec4:
    """How u and v change along the row, then down the column, at the distance `far`."""
    e = world.vertices[b] - world.vertices[a]
    f = world.vertices[c] - world.vertices[a]
    p = wp.cross(f, along)
    q = wp.cross(along, e)
    scale = far / wp.dot(e, p)
    right = step_right(eye.rays, row, column)
    down = step_down(eye.rays, row, column)
    rightwards = scale * (eye.turn * wp.vec3(right[0], right[1], 0.0))
    downwards = scale * (eye.turn * wp.vec3(down[0], down[1], 0.0))
    return wp.vec4(
        wp.dot(rightwards, p), wp.dot(rightwards, q), wp.dot(downwards, p), wp.dot(downwards, q)
    )


@wp.func
def shade(
    world: World,
    eye: Eye,
    along: wp.vec3,
    hit: wp.MeshQueryRay,
    row: int,
    column: int,
    width: float,
) -> wp.vec3:
    """Colour (0 to 255) of what a ray has hit; it stands for `width` of a pixel."""
    a = world.surface.triangles[hit.face, 0]
    b = world.surface.triangles[hit.face, 1]
    c = world.surface.triangles[hit.face, 2]
    # Warp's weights are of corners 0 and 1
    u = hit.v
    v = 1.0 - hit.u - hit.v
    own = wp.vec3(1.0, 1.0, 1.0)
    if world.coloured != 0:
        for k in range(3):
            own[k] = (
                hit.u * float(world.surface.colours[a, k])
                + u * float(world.surface.colours[b, k])
                + v * float(world.surface.colours[c, k])
            ) / 255.0
    texture = world.surface.texture_of[hit.face]
    columns = world.surface.levels[texture, 0, 1]
    rows = world.surface.levels[texture, 0, 2]
    colour = wp.vec3(0.0, 0.0, 0.0)
    if columns * rows == 1:
        only = world.surface.levels[texture, 0, 0]
        for k in range(3):
            colour[k] = own[k] * float(world.surface.texels[only, k])
        return colour
    to_b = uv_step(world.surface, a, b)
    to_c = uv_step(world.surface, a, c)
    moved = steps(world, eye, along, a, b, c, width * hit.t, row, column)
    longer = moved[0] * to_b + moved[1] * to_c
    shorter = moved[2] * to_b + moved[3] * to_c
    size = wp.vec2(float(columns), float(rows))
    most = wp.length_sq(wp.cw_mul(longer, size))
    least = wp.length_sq(wp.cw_mul(shorter, size))
    if least > most:
        longer = shorter
    plan = looks(wp.max(most, least), wp.min(most, least), world.surface.levels.shape[1] - 1)
    st = wp.vec2(world.surface.uv[a, 0], world.surface.uv[a, 1]) + u * to_b + v * to_c
    level = int(plan[1])
    for tap in range(int(plan[0])):
        at = (float(tap) + 0.5) / plan[0] - 0.5
        x = st + at * longer
        seen = between(world.surface, texture, level, x)
        if plan[2] > 0.0:
            coarse = between(world.surface, texture, level + 1, x)
            seen = (1.0 - plan[2]) * seen + plan[2] * coarse
        colour = colour + seen / plan[0]
    return wp.cw_mul(own, colour)


@wp.kernel(enable_backward=False)
def draw(world: World, eye: Eye, picture: Picture):
    """One ray a pixel (`render_kernels.draw`); pixels that see nothing are left alone."""
    row, column = wp.tid()
    along = direction(eye, eye.rays[row, column])
    hit = wp.mesh_query_ray(world.mesh, eye.origin, along, FARTHEST)
    if hit.result:
        picture.depth[row, column] = hit.t
        picture.triangles[row, column] = hit.face
        picture.objects[row, column] = world.surface.object_of[hit.face]
        picture.points[row, column] = eye.origin + hit.t * along
        colour = shade(world, eye, along, hit, row, column, 1.0)
        for k in range(3):
            picture.colour[row, column, k] = wp.uint8(colour[k] + 0.5)


@wp.func
def normal(world: World, triangle: int) -> wp.vec3:
    """Unit normal of a triangle; zero where it has no area."""
    a = world.vertices[world.surface.triangles[triangle, 0]]
    b = world.vertices[world.surface.triangles[triangle, 1]]
    c = world.vertices[world.surface.triangles[triangle, 2]]
    return wp.normalize(wp.cross(b - a, c - a))


@wp.func
def parted(world: World, picture: Picture, row: int, column: int, i: int, j: int) -> bool:
    """Whether an edge that can be seen runs between two pixels (`render_kernels.edges`)."""
    if i < 0 or j < 0 or i >= picture.triangles.shape[0] or j >= picture.triangles.shape[1]:
        return False
    one = picture.triangles[row, column]
    other = picture.triangles[i, j]
    if other == one or other < 0:
        return False
    contrast = int(0)
    for k in range(3):
        step = int(picture.colour[row, column, k]) - int(picture.colour[i, j, k])
        contrast = wp.max(contrast, wp.abs(step))
    if contrast < CONTRAST:
        return False
    if picture.objects[row, column] != picture.objects[i, j]:
        return True
    if world.surface.texture_of[one] != world.surface.texture_of[other]:
        return True
    facing = normal(world, one)
    gap = wp.dot(facing, picture.points[i, j] - picture.points[row, column])
    if wp.abs(gap) > JUMP * picture.depth[row, column]:
        return True
    return wp.abs(wp.dot(facing, normal(world, other))) < CREASE


@wp.kernel(enable_backward=False)
def smooth(
    world: World,
    eye: Eye,
    picture: Picture,
    offsets: wp.array(dtype=wp.vec2),
    colour: wp.array3d(dtype=wp.uint8),
):
    """Draw edges anew into `colour`, as means of several rays (`render_kernels.smooth`)."""
    row, column = wp.tid()
    if picture.triangles[row, column] < 0:
        return
    if not (
        parted(world, picture, row, column, row, column + 1)
        or parted(world, picture, row, column, row + 1, column)
        or parted(world, picture, row, column, row, column - 1)
        or parted(world, picture, row, column, row - 1, column)
    ):
        return
    width = 1.0 / wp.sqrt(float(offsets.shape[0]))
    right = step_right(eye.rays, row, column)
    down = step_down(eye.rays, row, column)
    total = wp.vec3(0.0, 0.0, 0.0)
    hits = float(0.0)
    for k in range(offsets.shape[0]):
        ray = eye.rays[row, column] + offsets[k][0] * right + offsets[k][1] * down
        along = direction(eye, ray)
        hit = wp.mesh_query_ray(world.mesh, eye.origin, along, FARTHEST)
        if hit.result:
            total = total + shade(world, eye, along, hit, row, column, width)
            hits = hits + 1.0
    if hits > 0.0:
        for k in range(3):
            colour[row, column, k] = wp.uint8(total[k] / hits + 0.5)
