"""Names that tools do not show unless asked."""

__all__ = ["HIDDEN_TOPIC_PREFIX", "topic_or_service_is_hidden"]

HIDDEN_TOPIC_PREFIX = "_"


def topic_or_service_is_hidden(name: str) -> bool:
    """Whether any part of the name starts with an underscore."""
    return any(part.startswith(HIDDEN_TOPIC_PREFIX) for part in name.split("/"))
