"""Text of others, made fit to be printed."""


def printable(text: str) -> str:
    """A text without anything that would control a terminal."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)
