"""One short recording's episodes and messages, as its tests want them."""

from bag_fixtures import made, team

__all__ = ["made", "team"]
