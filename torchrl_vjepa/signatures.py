"""What ``inspect.signature`` tells of classes whose metaclass hides it."""

from __future__ import annotations

import inspect

__all__ = ["InitSignature"]


class InitSignature:
    """``__signature__`` of a class: that of its own ``__init__``.

    The metaclass of TorchRL's environments takes ``(*args, **kwargs)``, which is all that editors would show.

    Examples:
        >>> class Meta(type):
        ...     def __call__(cls, *args, **kwargs):
        ...         return super().__call__(*args, **kwargs)
        >>> class Env(metaclass=Meta):
        ...     __signature__ = InitSignature()
        ...     def __init__(self, size: int) -> None: ...
        >>> list(inspect.signature(Env).parameters)
        ['size']
    """

    def __get__(self, instance: object | None, owner: type) -> inspect.Signature:
        """The signature.

        Args:
            instance: ``None``: what an instance is called with is another matter.
            owner: the class.

        Returns:
            That of the class.

        Raises:
            AttributeError: for an instance.
        """
        if instance is not None:
            raise AttributeError("__signature__ is that of the class")
        full = inspect.signature(owner.__init__)  # type: ignore[misc]
        return full.replace(
            parameters=list(full.parameters.values())[1:], return_annotation=inspect.Signature.empty
        )
