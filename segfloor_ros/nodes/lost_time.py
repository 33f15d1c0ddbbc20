"""For how long tracking has been lost: for the node `stereo_slam`."""

from __future__ import annotations

from segfloor_ros.nodes.stage_node import AnyStageNode


class LostTime:
    """Measures by the stamps of the frames. found: whether any frame has been tracked."""

    def __init__(self, node: AnyStageNode) -> None:
        self.found = False
        self._node = node
        self._since_ns: int | None = None

    def lost_s(self, stamp_ns: int) -> float:
        """Return for how long tracking has been lost, in s."""
        return 0.0 if self._since_ns is None else 1e-9 * (stamp_ns - self._since_ns)

    def note(self, stamp_ns: int, tracked: bool) -> dict[str, str]:
        """Note a frame; returns values for its status: for how long tracking has been lost, or,
        where it was found again, after how long.
        """
        if not tracked:
            self._since_ns = stamp_ns if self._since_ns is None else self._since_ns
            return {'lost_s': f'{self.lost_s(stamp_ns):.2f}'}
        lost_s, was_lost = self.lost_s(stamp_ns), self._since_ns is not None
        self.found, self._since_ns = True, None
        if not was_lost:
            return {}
        self._node.get_logger().info(f'tracking again, after {lost_s:.2f} s')
        return {'recovered_after_s': f'{lost_s:.2f}'}
