"""Gathers the points that each view sees, and scatters their gradients."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    index2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
    flags2 = ti.types.ndarray(dtype=ti.u8, ndim=2)

    @ti.kernel
    def gather_visible(
        points: points3,
        visible: flags2,
        sampled: points3,
        index: index2,
        views: ti.i32,
        spread: ti.i32,
    ):
        """Visible points moved to the front of each view's row, in their own order; zeros and -1 after them."""
        for step in range(visible.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                slot = 0
                for i in range(points.shape[1]):
                    if visible[view, i] != 0:
                        for k in ti.static(range(3)):
                            sampled[view, slot, k] = points[cloud, i, k]
                        index[view, slot] = i
                        slot += 1
                for rest in range(slot, sampled.shape[1]):
                    for k in ti.static(range(3)):
                        sampled[view, rest, k] = real(0.0)
                    index[view, rest] = -1

    @ti.kernel
    def scatter_visible(
        index: index2, grad_sampled: points3, grad_points: points3, views: ti.i32, spread: ti.i32
    ):
        for step in range(grad_points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for view in range(cloud * views, cloud * views + views):
                    for slot in range(index.shape[1]):
                        i = ti.cast(index[view, slot], ti.i32)
                        if i >= 0:
                            for k in ti.static(range(3)):
                                grad_points[cloud, i, k] = (
                                    grad_points[cloud, i, k] + grad_sampled[view, slot, k]
                                )

    return SimpleNamespace(gather_visible=gather_visible, scatter_visible=scatter_visible)
