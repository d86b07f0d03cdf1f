"""Messages to a person: at most MAX_MESSAGE characters, whatever they quote."""

MAX_MESSAGE = 1000


def shorten(text):
    """Return the text without its middle if it is longer than a message may be."""
    half = MAX_MESSAGE // 2
    return text if len(text) <= MAX_MESSAGE else f"{text[:half]} ... {text[-half:]}"


def number_of(count, thing):
    """Return a count with its noun: "1 anchor", "2 anchors"."""
    return f"1 {thing}" if count == 1 else f"{count} {thing}s"
