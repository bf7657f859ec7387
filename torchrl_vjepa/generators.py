"""Random generators: new ones from old ones, and in a form that can be sent to other processes."""

from __future__ import annotations

import torch

__all__ = ["offspring", "pack_generator", "unpack_generator"]


def pack_generator(generator: torch.Generator) -> tuple[str, bytes]:
    """Device and state of a generator, in a form that survives every way of pickling.

    ``torch.Generator`` pickles its state as a temporary tensor, whose file descriptor is closed too
    early when a process is spawned.

    Args:
        generator: the generator.

    Returns:
        Name of its device, and its state.

    Examples:
        >>> pack_generator(torch.Generator())[0]
        'cpu'
    """
    return str(generator.device), generator.get_state().numpy().tobytes()


def unpack_generator(packed: tuple[str, bytes]) -> torch.Generator:
    """The inverse of :func:`pack_generator`.

    Args:
        packed: device and state.

    Returns:
        A generator that continues where the packed one was.

    Examples:
        >>> generator = torch.Generator().manual_seed(0)
        >>> copy = unpack_generator(pack_generator(generator))
        >>> torch.equal(torch.rand(3, generator=generator), torch.rand(3, generator=copy))
        True
    """
    device, state = packed
    generator = torch.Generator(device)
    generator.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))
    return generator


def offspring(generator: torch.Generator, device: torch.device) -> torch.Generator:
    """A new generator, seeded by a draw from another.

    Args:
        generator: the other, which moves on by one number.
        device: of the new one.

    Returns:
        The new one.

    Examples:
        >>> offspring(torch.Generator().manual_seed(0), torch.device("cpu")).device
        device(type='cpu')
    """
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator(device).manual_seed(int(seed))
