"""The entropy coder: rANS with a 64-bit state, in one lane for short messages, else in several.

MODEL. A message is a sequence of entries from frequency tables, and the decoder knows which table
each of them is from. All tables form one ascending array of integers, `keys`: table u lists its
entries as (u << 24) + cum, beginning with cum = 0, and the last element of the array is (number of
tables) << 24. Entry i has start = keys[i] mod 2^24 and the frequency keys[i+1] - keys[i], from 1 to
2^24 - 1. The frequencies of every table add up to 2^24.

ONE LANE is an integer x, 2^31 <= x < 2^63, called the state, and a stack of 32-bit words. It has
four operations:

    push an entry    if x >= freq 2^39: put x mod 2^32 on the stack and set x = floor(x / 2^32);
                     then x = floor(x / freq) 2^24 + x mod freq + start
    pop an entry     slot = x mod 2^24; take the entry of the table with
                     start <= slot < start + freq; x = floor(x / 2^24) freq + slot - start;
                     then, if x < 2^31, take a word from the stack and set x = x 2^32 + word
    push b bits v    if x >= 2^(63-b): put x mod 2^32 on the stack and set x = floor(x / 2^32);
                     then x = x 2^b + v
    pop b bits       v = x mod 2^b; x = floor(x / 2^b);
                     then, if x < 2^31, take a word from the stack and set x = x 2^32 + word

Push and pop undo each other exactly. The encoder therefore begins with the last symbol, and the
decoder ends with it.

L LANES, L a power of two, take turns and share one stack. Of n symbols, the last m form the tail,
and n - m is a multiple of L. Symbol i < n - m belongs to lane i mod L, and the tail belongs to
lane 0. With one lane the tail is the whole message. The encoder

    1. sets lane 0 to 2^31 and pushes the tail, last symbol first, until the stack has L words and
       the number of symbols left is a multiple of L;
    2. starts lane 1, then 2, ... L-1 at 2^31 + v, where v is 31 bits popped from lane 0, so that
       starting a lane costs nothing;
    3. pushes the other symbols row by row, L symbols to a row, last row first, and within a row
       lane L-1 first;
    4. closes lane L-1, then L-2, ... 1: with n = (number of binary digits of its state) - 32, it
       pushes into lane 0 the 31 low bits of that state, then the n bits between them and the
       leading one, then n as 5 bits (this costs about 4.5 bits per lane);
    5. writes lane 0 and then the stack, its top first.

The decoder reverses these steps, with push and pop exchanged. In their order it

    5. reads lane 0 and the stack;
    4. opens lane 1, then 2, ... L-1: pops n (5 bits), then v (n bits), then w (31 bits) from
       lane 0; the state of the lane is (2^n + v) 2^31 + w;
    3. pops symbol 0, 1, ... n-m-1, each from its lane;
    2. ends lane L-1, then L-2, ... 1, whose state must now be from 2^31 to 2^32 - 1: pushes its
       31 low bits into lane 0;
    1. pops the tail from lane 0, whose state must end at 2^31. The tail must have taken every word
       that step 2 put on the stack.

With several lanes the tail is never empty.

BYTES, all integers little-endian. A message of no symbols has no bytes. Any other message has

    1 byte          bits 0 to 3: log2 L, from 0 to 10; bits 4 to 6: zero; bit 7: whether lane 0
                    has a high word
    4 bytes         m, only if L > 1
    4 or 8 bytes    the state of lane 0: its low word, then its high word if it is not zero
    4 bytes each    the words of the stack, its top first

What follows the last word that is read does not belong to the message. The encoder may choose L.
This one takes the largest power of two that leaves about 5000 bits to each lane, at most 1024, or 1
if that would be below 32.

Worked example. One table with the keys 0, 12582912, 16777216 gives its two entries the
probabilities 3/4 and 1/4. The message 0 1 0 is pushed from its last symbol on: x = 2^31 becomes
2860515328, then 11454644224, then 15271460864 = 0x38E400000. The bytes are

    80  00 00 40 8E 03 00 00 00
"""

from bisect import bisect_right
from itertools import cycle

import numpy as np

from .container import BitstreamError, expect

PRECISION, WORD, LOWEST = 24, 32, 1 << 31
# The total of a table's frequencies; masks of the bits of a slot and of a word.
CERTAIN, SLOT, LOW_WORD = 1 << PRECISION, (1 << PRECISION) - 1, (1 << WORD) - 1
MAX_LANES, MIN_LANES, BITS_PER_LANE = 1024, 32, 5000
PIECE = 8 * MAX_LANES  # numbers converted to Python integers at a time: whole rows


def bit_length(values):
    """Return the number of binary digits of integers from 0 to 2^53, int64."""
    return np.frexp(values)[1].astype(np.int64)


def encode(entries, keys, lanes=None, push_rows=None):
    """Return the bytes of a message: entries [n], indices into keys [E+1].

    `lanes` overrides the encoder's choice, and `push_rows` may be `push_rows_plainly`. Raises
    ValueError for a message that is too short for that many lanes.
    """
    if len(entries) == 0:
        return b""
    starts, freqs = keys[entries] & SLOT, np.diff(keys)[entries]
    lanes = lanes or choose_lanes(freqs)
    x, stack, left = push_tail(starts, freqs, lanes)
    states = start_lanes(x, lanes, stack)
    states, row_words = (push_rows or push_rows_fast)(states, starts[:left], freqs[:left])
    x, top = close_lanes(states)
    tail = (len(entries) - left).to_bytes(4, "little") if lanes > 1 else b""
    high = 0x80 if x > LOW_WORD else 0
    head = bytes([lanes.bit_length() - 1 | high]) + tail + x.to_bytes(8 if high else 4, "little")
    words = [np.asarray(part, np.int64) for part in (top[::-1], row_words, stack[::-1])]
    return head + np.concatenate(words).astype("<u4").tobytes()


def choose_lanes(freqs):
    """Return the number of lanes, in integers, so that every machine writes the same bytes."""
    # 24 - log2 f from above, because log2(1 + a) >= a: too many by at most 0.09 bits per symbol.
    length = bit_length(freqs)
    bits = (PRECISION + 2 - length << PRECISION) - (freqs << PRECISION + 1 - length)
    most = (int(bits.sum()) >> PRECISION) // BITS_PER_LANE
    return min(1 << most.bit_length() - 1, MAX_LANES) if most >= MIN_LANES else 1


def push_tail(starts, freqs, lanes):
    """Do step 1 in lane 0; return its state, the stack, and how many symbols are left for rows."""
    x, stack, left = LOWEST, [], len(starts)
    some = lanes if lanes > 1 else PIECE
    # Starting a lane takes 31 bits, so as many words as lanes suffice.
    while left and (lanes == 1 or len(stack) < lanes):
        first = (left - 1) // some * some
        (x,), words = push_rows_plainly([x], starts[first:left], freqs[first:left])
        left, stack = first, stack + words[::-1]
    if lanes > 1 and len(stack) < lanes:
        raise ValueError(f"{len(starts)} symbols are too short a message for {lanes} lanes")
    return x, stack, left


def push_bits(x, b, v, words):
    """Push b bits v into a lane; return its new state."""
    if x >= 1 << 63 - b:
        words.append(x & LOW_WORD)
        x >>= WORD
    return x << b | v


def pop_bits(x, b, words):
    """Pop b bits from a lane; return its new state, and the bits."""
    v, x = x & (1 << b) - 1, x >> b
    return (x if x >= LOWEST else x << WORD | words.pop()), v


def start_lanes(x, lanes, words):
    """Do step 2; return the states of all lanes."""
    states = [x]
    for _ in range(1, lanes):
        states[0], v = pop_bits(states[0], 31, words)
        states.append(LOWEST + v)
    return states


def close_lanes(states):
    """Do step 4; return the state of lane 0 with all lanes in it, and the words that it pushed."""
    x, words = states[0], []
    for state in reversed(states[1:]):
        n = state.bit_length() - 32
        for b, v in (31, state & LOWEST - 1), (n, (state >> 31) - (1 << n)), (5, n):
            x = push_bits(x, b, v, words)
    return x, words


def push_rows_plainly(states, starts, freqs):
    """Do step 3 symbol by symbol; return the states, and the words in the decoder's order.

    With one lane it is step 1.
    """
    states, words = [*states], []
    lanes = cycle(reversed(range(len(states))))
    for lane, start, freq in zip(lanes, starts[::-1].tolist(), freqs[::-1].tolist()):
        x = states[lane]
        if x >= freq << 39:
            words.append(x & LOW_WORD)
            x >>= WORD
        # x + floor(x / freq) (2^24 - freq) = floor(x / freq) 2^24 + x mod freq
        states[lane] = x + x // freq * (CERTAIN - freq) + start
    return states, words[::-1]


def push_rows_fast(states, starts, freqs):
    """Do what `push_rows_plainly` does over all lanes at once; x and freq 2^39 fit into int64."""
    x = np.array(states, np.int64)
    starts, freqs = (values.reshape(-1, len(x)) for values in (starts, freqs))
    limits, rest = freqs << 39, (1 << PRECISION) - freqs
    before, full = np.empty_like(starts), np.empty(starts.shape, bool)
    for row in reversed(range(len(starts))):
        before[row] = x
        np.greater_equal(x, limits[row], out=full[row])
        x >>= full[row] * WORD
        x += x // freqs[row] * rest[row] + starts[row]
    return x.tolist(), before[full] & LOW_WORD  # row by row, lane by lane: the decoder's order


def decode(data, tables, keys, at=0, section="stream", pop_rows=None):
    """Decode the message that begins at byte `at`; return entries [n] int32 and where it ends.

    `tables` [n] is the number of every symbol's table; `pop_rows` may be `pop_rows_plainly`. Raises
    BitstreamError if the data end early or no encoder can have written them.
    """
    entries = np.empty(len(tables), np.int32)
    if len(tables) == 0:
        return entries, at
    lanes, left, x, start = read_head(data, at, len(tables), section)
    # A symbol takes at most one word and the opening of a lane at most three: no more are needed.
    count = min((len(data) - start) // 4, len(tables) + 3 * lanes)
    words = np.frombuffer(data, "<u4", count, start)
    end = start + 4 * count
    try:
        states, words = open_lanes(x, lanes, words)
        pop_rows = pop_rows or pop_rows_fast
        states, words = pop_rows(states, words, tables[:left], keys, entries[:left])
        expect(
            all(state >> 31 == 1 for state in states[1:]),
            section,
            end - 4 * len(words),
            "a lane does not end where lanes start",
        )
        unread = len(words)
        x, words = end_lanes(states, words)
        (x,), words = pop_rows_plainly([x], words, tables[left:], keys, entries[left:])
    except IndexError:  # of an empty stack
        raise BitstreamError(section, len(data), "the data end before the last symbol") from None
    end -= 4 * len(words)
    expect(x == LOWEST, section, end, f"lane 0 ends in state {x}, not in {LOWEST}")
    expect(len(words) <= unread, section, end, "the tail leaves a word that a lane gave back")
    return entries, end


def read_head(data, at, count, section):
    """Return the number of lanes, symbols in rows, the state of lane 0, and where words begin."""
    first = data[at] if len(data) > at else 0
    lanes, size = 1 << (first & 15), 8 if first & 0x80 else 4
    start = at + (5 if lanes > 1 else 1) + size
    expect(len(data) >= start, section, len(data), "the data end before the first symbol")
    expect(
        not first & 0x70 and lanes <= MAX_LANES,
        section,
        at,
        f"lane byte {first:#04x} is not in use",
    )
    tail = int.from_bytes(data[at + 1 : at + 5], "little") if lanes > 1 else count
    expect(
        0 < tail <= count and (count - tail) % lanes == 0,
        section,
        at + 1,
        f"a tail of {tail} of {count} symbols does not fit {lanes} lanes",
    )
    x = int.from_bytes(data[start - size : start], "little")
    expect(
        LOWEST <= x < 1 << 63 and (size == 4 or x > LOW_WORD),
        section,
        start - size,
        f"no encoder ends in state {x}",
    )
    return lanes, count - tail, x, start


def open_lanes(x, lanes, words):
    """Do step 4 of the decoder; return the states of all lanes, and the words left."""
    stack = words[: 3 * lanes][::-1].tolist()  # a lane has at most 67 bits, so three words suffice
    states, given = [x], len(stack)
    for _ in range(1, lanes):
        states[0], n = pop_bits(states[0], 5, stack)
        states[0], v = pop_bits(states[0], n, stack)
        states[0], w = pop_bits(states[0], 31, stack)
        states.append((1 << n) + v << 31 | w)
    return states, words[given - len(stack) :]


def end_lanes(states, words):
    """Do step 2 of the decoder; return the state of lane 0, and its words before those left."""
    x, pushed = states[0], []
    for state in reversed(states[1:]):
        x = push_bits(x, 31, state - LOWEST, pushed)
    return x, np.concatenate([np.array(pushed[::-1], words.dtype), words])


def pop_rows_plainly(states, words, tables, keys, entries):
    """Do step 3 of the decoder symbol by symbol: fill `entries`, return states and words left.

    With one lane it is step 1.
    """
    # Lists are faster to read than arrays, but take time to make.
    form = np.ndarray.tolist if len(keys) < 4 * len(tables) else memoryview
    starts, freqs = form(keys & SLOT), form(np.diff(keys))
    first = keys.searchsorted(np.arange(0, keys[-1] + 1, CERTAIN))  # entry of every table
    states, lanes = [*states], range(len(states))
    for a in range(0, len(tables), PIECE):
        stack, popped = words[:PIECE][::-1].tolist(), []  # a symbol takes one word at most
        given, used = len(stack), tables[a : a + PIECE]
        lows, highs = first[used].tolist(), first[1:][used].tolist()
        for lane, low, high in zip(cycle(lanes), lows, highs):
            x = states[lane]
            slot = x & SLOT
            entry = bisect_right(starts, slot, low, high) - 1  # searches one table only
            x = (x >> PRECISION) * freqs[entry] + slot - starts[entry]
            if x < LOWEST:
                x = x << WORD | stack.pop()
            states[lane] = x
            popped.append(entry)
        entries[a : a + PIECE] = popped
        words = words[given - len(stack) :]
    return states, words


def pop_rows_fast(states, words, tables, keys, entries):
    """Do what `pop_rows_plainly` does over all lanes at once."""
    x, count = np.array(states, np.int64), 0
    tables, entries = (values.reshape(-1, len(x)) for values in (tables, entries))
    for row in range(len(tables)):
        target = tables[row].astype(np.int64) << PRECISION | x & SLOT
        entry = keys.searchsorted(target, "right") - 1
        entries[row] = entry
        start = keys.take(entry)
        x = (x >> PRECISION) * (keys.take(entry + 1) - start) + target - start
        short = (x < LOWEST).nonzero()[0]
        if len(short):
            fresh = words[count : count + len(short)]
            if len(fresh) < len(short):
                raise IndexError
            x[short] = x[short] << WORD | fresh
            count += len(short)
    return x.tolist(), words[count:]
