"""Kernels for NVIDIA Warp: closest hits. Warp reads the annotations, so they are values here."""

import warp as wp

INFINITE = wp.constant(wp.float32(3.0e38))


@wp.struct
class Surface:
    """`surface.Surface`."""

    triangles: wp.array2d(dtype=wp.int32)
    object_of: wp.array(dtype=wp.int32)
    colours: wp.array2d(dtype=wp.uint8)
    uv: wp.array2d(dtype=wp.float32)
    texture_of: wp.array(dtype=wp.int32)
    texels_per_metre: wp.array(dtype=wp.float32)
    levels: wp.array3d(dtype=wp.int32)
    texels: wp.array2d(dtype=wp.uint8)


@wp.kernel(enable_backward=False)
def cast(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float32),
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
):
    """Rays (N,); one without direction hits nothing. Outputs are left alone where nothing is hit."""
    i = wp.tid()
    direction = directions[i]
    if wp.dot(direction, direction) == 0.0:
        return
    hit = wp.mesh_query_ray(mesh, origins[i], direction, INFINITE)
    if hit.result:
        triangle[i] = hit.face
        distance[i] = hit.t
        # Warp's weights are of corners 0 and 1
        u[i] = hit.v
        v[i] = 1.0 - hit.u - hit.v
