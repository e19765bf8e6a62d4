"""What is wrong with a message, or with the definition of its type."""

from __future__ import annotations


class MessageError(ValueError):
    """A message whose content cannot be used; the text says what it holds and what would be right."""


class DefinitionMissing(ValueError):
    """A message type whose .msg file is not installed; the message says where it was looked for."""


class DefinitionDamaged(ValueError):
    """A definition that is none, or cannot be used; the message says why."""
