"""The entropy coder: rANS with a 64-bit state, one lane for short messages and several in step for long ones.

THE MODEL is one ascending array of integers, `keys`: table u lists its entries as (u << 24) + cum, cum = 0 first, and
the last element of the array is (number of tables) << 24.  Entry i has start = keys[i] mod 2^24 and frequency
keys[i+1] - keys[i], 1..2^24 - 1; every table totals 2^24.  A message is a sequence of entries, and the decoder knows
which table each of them is from.

ONE LANE is an integer x, 2^31 <= x < 2^63, above a stack of 32-bit words.
    push entry       if x >= freq * 2^39: put x mod 2^32 on the stack, x = floor(x / 2^32)
                     x = floor(x / freq) * 2^24 + x mod freq + start
    pop from u       slot = x mod 2^24, take the one entry of table u with start <= slot < start + freq
                     x = floor(x / 2^24) * freq + slot - start;  if x < 2^31: x = x * 2^32 + (word from the stack)
    push b bits v    if x >= 2^(63-b): put x mod 2^32 on the stack, x = floor(x / 2^32);   then x = x * 2^b + v
    pop b bits       v = x mod 2^b, x = floor(x / 2^b);  if x < 2^31: x = x * 2^32 + (word from the stack)
Push and pop undo each other exactly, so the encoder starts with the last symbol and the decoder ends with it.

L LANES (a power of two) work in step and share the stack.  With n symbols and a tail of m (n - m a multiple of L),
symbol i < n - m belongs to lane i mod L, the tail to lane 0 alone.  The encoder
    1. sets lane 0 to 2^31 and pushes the tail, last symbol first, until the stack holds L words and n - m fits;
    2. starts lane 1, then 2, ... L-1 at 2^31 + v where v is popped from lane 0 as 31 bits: no bit is spent on a start;
    3. pushes the other symbols, last row of L first; within a row lane L-1 puts its word on the stack first;
    4. puts away lane L-1, then L-2, ... 1 into lane 0: with n = bit length of x minus 32 it pushes the 31 low
       bits of x, then the n bits under the top one, then n as 5 bits (about 4.5 bits a lane are lost here);
    5. writes lane 0 and then the stack, its top first.
The decoder does the same backwards, "push" and "pop" exchanged:
    4. for lane 1, 2, ... L-1: pops n (5 bits), then v (n bits), then w (31 bits) from lane 0; the lane is
       (2^n + v) 2^31 + w
    3. pops symbol 0, 1, ... n-m-1, each from its lane
    2. for lane L-1, L-2, ... 1, which must lie in 2^31..2^32 - 1: pushes its 31 low bits into lane 0
    1. pops the tail from lane 0, which must end at 2^31.  Where L > 1 the tail is never empty.

BYTES, little-endian.  Nothing at all for n = 0.  Otherwise
    1        bits 0-3: log2 L, 0..10;  bits 4-6: zero;  bit 7: lane 0 has a high word
    4        m, only where L > 1
    4 or 8   lane 0: low word, then the high word (not zero) where it has one
    4 ...    the stack, its top first
What follows the last word read is not this coder's: `decode` returns where it stopped.

L is the encoder's choice; this one takes the largest power of two that leaves each lane about 5000 bits, at
most 1024, or 1 where that is below 32.

WORKED NUMBERS.  keys = 0, 12582912, 16777216 (one table, probabilities 3/4 and 1/4), message 0 1 0.  From the last
symbol on, x = 2^31 becomes 2860515328, 11454644224, 15271460864 = 0x38E400000.  Bytes: 80 00 00 40 8E 03 00 00 00.
"""

from bisect import bisect_right

import numpy as np

from .container import BitstreamError

PRECISION, WORD, LOWEST = 24, 32, 1 << 31
SLOT, LOW_WORD = (1 << PRECISION) - 1, (1 << WORD) - 1
MAX_LANES, MIN_LANES, BITS_PER_LANE, PIECE = 1024, 32, 5000, 8192


def encode(entries, keys, lanes=None, push_rows=None):
    """Code a message.

    Shapes     entries (n,) indices into keys, keys (E+1,) -> bytes
    Domain     the model above; `lanes` overrides the choice; `push_rows` may be the readable `push_rows_plainly`
    Raises     ValueError where the message is too short for that many lanes
    """
    if len(entries) == 0:
        return b""
    starts, freqs = keys[entries] & SLOT, np.diff(keys)[entries]
    lanes = lanes or choose_lanes(freqs)
    x, stack, left = _push_tail(starts, freqs, lanes)
    head, row_words, top = b"", [], []
    if lanes > 1:
        head = (len(entries) - left).to_bytes(4, "little")
        states = _start_lanes(x, lanes, stack)
        states, row_words = (push_rows or _push_rows)(
            states, starts[:left].reshape(-1, lanes), freqs[:left].reshape(-1, lanes)
        )
        x, top = _put_away(states)
    high = 0x80 if x > LOW_WORD else 0
    parts = (top[::-1], row_words, stack[::-1])
    return (
        bytes([lanes.bit_length() - 1 | high])
        + head
        + x.to_bytes(8 if high else 4, "little")
        + b"".join(np.asarray(part, np.int64).astype("<u4").tobytes() for part in parts)
    )


def choose_lanes(freqs):
    """How many lanes the encoder takes, decided in integers so that every machine writes the same bytes."""
    # log2 f from below, by log2(1 + a) >= a; at most 0.09 bit a symbol too dear.  frexp is exact for integers
    length = np.frexp(freqs.astype(np.float64))[1].astype(np.int64)
    bits = (
        int(np.sum((PRECISION + 2 - length << PRECISION) - (freqs << PRECISION + 1 - length)))
        >> PRECISION
    )
    lanes = min(1 << max((bits // BITS_PER_LANE).bit_length() - 1, 0), MAX_LANES)
    return lanes if lanes >= MIN_LANES else 1


def _push_tail(starts, freqs, lanes):
    """Step 1, lane 0 alone: its state, the stack, and how many symbols are left for the rows."""
    x, words, left = LOWEST, [], len(starts)
    for start, freq in zip(_backwards(starts), _backwards(freqs)):
        if (
            lanes > 1 and left % lanes == 0 and len(words) >= lanes
        ):  # 31 bits a lane: `lanes` words feed them all
            break
        if x >= freq << 39:
            words.append(x & LOW_WORD)
            x >>= WORD
        high, low = divmod(x, freq)
        x = (high << PRECISION) + low + start
        left -= 1
    if lanes > 1 and (left % lanes or len(words) < lanes):
        raise ValueError(f"{len(starts)} symbols are too short a message for {lanes} lanes")
    return x, words, left


def _backwards(values):
    """Python integers of an array from its end, converted piece by piece."""
    for end in range(len(values), 0, -PIECE):
        yield from reversed(values[max(end - PIECE, 0) : end].tolist())


def _push_bits(x, b, v, words):
    if x >= 1 << 63 - b:
        words.append(x & LOW_WORD)
        x >>= WORD
    return x << b | v


def _pop_bits(x, b, words):
    v, x = x & (1 << b) - 1, x >> b
    return (x if x >= LOWEST else x << WORD | words.pop()), v


def _start_lanes(x, lanes, words):
    """Step 2: the states of all lanes."""
    states = [x]
    for _ in range(1, lanes):
        states[0], v = _pop_bits(states[0], 31, words)
        states.append(LOWEST + v)
    return states


def _put_away(states):
    """Step 4: lane 0 with every other lane in it, and the words it pushed."""
    x, words = states[0], []
    for state in reversed(states[1:]):
        n = state.bit_length() - 32
        x = _push_bits(x, 31, state & LOWEST - 1, words)
        x = _push_bits(x, n, (state >> 31) - (1 << n), words)
        x = _push_bits(x, 5, n, words)
    return x, words


def push_rows_plainly(states, starts, freqs):
    """Step 3, readable: states after all rows, and the words in the order in which the decoder wants them."""
    words = []
    for row in reversed(range(len(starts))):
        for lane in reversed(range(len(states))):
            x, start, freq = states[lane], int(starts[row, lane]), int(freqs[row, lane])
            if x >= freq << 39:
                words.append(x & LOW_WORD)
                x >>= WORD
            states[lane] = (x // freq << PRECISION) + x % freq + start
    return states, np.array(words[::-1], np.int64)


def _push_rows(states, starts, freqs):
    """Step 3 over all lanes at once; int64 carries x < 2^63 and freq * 2^39 < 2^63."""
    x = np.array(states, np.int64)
    limits, rest = freqs << 39, (1 << PRECISION) - freqs
    before, full = np.empty_like(starts), np.empty(starts.shape, bool)
    shift, high = np.empty_like(x), np.empty_like(x)
    for row in reversed(range(len(starts))):
        before[row] = x
        np.greater_equal(x, limits[row], out=full[row])
        np.multiply(full[row], WORD, out=shift)
        x >>= shift
        np.floor_divide(x, freqs[row], out=high)
        high *= rest[row]  # x + high * (2^24 - freq) = high * 2^24 + x mod freq
        x += high
        x += starts[row]
    return x.tolist(), before[full] & LOW_WORD  # row by row, lane by lane: the decoder's order


def decode(data, tables, keys, at=0, section="stream", pop_rows=None):
    """Decode the message that begins at byte `at`.

    Shapes     data bytes, tables (n,), keys (E+1,) -> entries (n,) int32, offset of the first byte not read
    Domain     the model above; `pop_rows` may be the readable `pop_rows_plainly`
    Raises     BitstreamError where data ends early or no encoder can have written it
    """
    entries = np.empty(len(tables), np.int32)
    if len(tables) == 0:
        return entries, at
    lanes, left, x, start = _read_head(data, at, len(tables), section)
    # a symbol reads one word at most, a lane that is taken out three: more are not this message's
    words = np.frombuffer(
        data, "<u4", min((len(data) - start) // 4, len(tables) + 3 * lanes), start
    )
    end = start + 4 * len(words)
    try:
        if lanes > 1:
            states, words = _take_out(x, lanes, words)
            states, words = (pop_rows or _pop_rows)(
                states,
                words,
                tables[:left].reshape(-1, lanes),
                keys,
                entries[:left].reshape(-1, lanes),
            )
            if any(state >> 31 != 1 for state in states[1:]):
                raise BitstreamError(
                    section, end - 4 * len(words), "a lane does not end where lanes start"
                )
            x, words = _end_lanes(states, words)
        x, words = _pop_tail(x, words, tables[left:], keys, entries[left:])
    except IndexError:  # of an empty stack
        raise BitstreamError(section, len(data), "the data end before the last symbol") from None
    if x != LOWEST:
        raise BitstreamError(
            section, end - 4 * len(words), f"lane 0 ends in state {x}, not in {LOWEST}"
        )
    return entries, end - 4 * len(words)


def _read_head(data, at, count, section):
    """Lanes, how many symbols are in the rows, the state of lane 0, and where the stack begins."""
    first = data[at] if len(data) > at else 0
    lanes, size = 1 << (first & 15), 8 if first & 0x80 else 4
    start = at + 1 + 4 * (lanes > 1) + size
    if len(data) < start:
        raise BitstreamError(section, len(data), "the data end before the first symbol")
    if first & 0x70 or lanes > MAX_LANES:
        raise BitstreamError(section, at, f"lane byte {first:#04x} is not in use")
    tail = int.from_bytes(data[at + 1 : at + 5], "little") if lanes > 1 else count
    if tail > count or (count - tail) % lanes or lanes > 1 and not tail:
        raise BitstreamError(
            section, at + 1, f"a tail of {tail} of {count} symbols does not fit {lanes} lanes"
        )
    x = int.from_bytes(data[start - size : start], "little")
    if not LOWEST <= x < 1 << 63 or size == 8 and x <= LOW_WORD:
        raise BitstreamError(section, start - size, f"state {x} is not one an encoder ends in")
    return lanes, count - tail, x, start


def _take_out(x, lanes, words):
    """Step 4 backwards: the states of all lanes and the words left."""
    stack = words[: 3 * lanes][::-1].tolist()  # 67 bits a lane at most, so three words suffice
    states, given = [x], len(stack)
    for _ in range(1, lanes):
        states[0], n = _pop_bits(states[0], 5, stack)
        states[0], high = _pop_bits(states[0], n, stack)
        states[0], low = _pop_bits(states[0], 31, stack)
        states.append((1 << n) + high << 31 | low)
    return states, words[given - len(stack) :]


def _end_lanes(states, words):
    """Step 2 backwards: lane 0 with its bits given back, and the words it pushed before those left."""
    x, pushed = states[0], []
    for state in reversed(states[1:]):
        x = _push_bits(x, 31, state - LOWEST, pushed)
    return x, np.concatenate([np.array(pushed[::-1], words.dtype), words])


def _pop_tail(x, words, tables, keys, entries):
    """Step 1 backwards: fill `entries`; the state and the words left."""
    edges, first = (
        keys.tolist(),
        keys.searchsorted(np.arange((int(keys[-1]) >> PRECISION) + 1) << PRECISION),
    )
    for a in range(0, len(tables), PIECE):
        stack, found = words[:PIECE][::-1].tolist(), []  # a symbol reads one word at most
        given, used = len(stack), tables[a : a + PIECE].astype(np.int64)
        for base, low, high in zip(
            (used << PRECISION).tolist(), first[used].tolist(), first[used + 1].tolist()
        ):
            target = base + (x & SLOT)
            entry = bisect_right(
                edges, target, low, high
            )  # the one after; only its own table is searched
            start = edges[entry - 1]
            x = (x >> PRECISION) * (edges[entry] - start) + target - start
            if x < LOWEST:
                x = x << WORD | stack.pop()
            found.append(entry)
        entries[a : a + PIECE] = found
        words = words[given - len(stack) :]
    entries -= 1
    return x, words


def pop_rows_plainly(states, words, tables, keys, entries):
    """Step 3 backwards, readable: fill `entries`; the states after all rows and the words left."""
    edges, stack = keys.tolist(), words[::-1].tolist()
    for row in range(len(tables)):
        for lane, x in enumerate(states):
            target = int(tables[row, lane]) << PRECISION | x & SLOT
            entry = bisect_right(edges, target) - 1
            x = (x >> PRECISION) * (edges[entry + 1] - edges[entry]) + target - edges[entry]
            if x < LOWEST:
                x = x << WORD | stack.pop()
            states[lane], entries[row, lane] = x, entry
    return states, words[len(words) - len(stack) :]


def _pop_rows(states, words, tables, keys, entries):
    """Step 3 backwards over all lanes at once."""
    x, freqs, count = np.array(states, np.int64), np.diff(keys), 0
    slot, target, entry = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    for row in range(len(tables)):
        np.left_shift(tables[row], PRECISION, out=target, dtype=np.int64)
        np.bitwise_and(x, SLOT, out=slot)
        target |= slot
        np.subtract(keys.searchsorted(target, "right"), 1, out=entry)
        entries[row] = entry
        x >>= PRECISION
        x *= freqs.take(entry)
        target -= keys.take(entry)
        x += target
        short = (x < LOWEST).nonzero()[0]
        if len(short):
            fresh = words[count : count + len(short)]
            if len(fresh) < len(short):
                raise IndexError
            x[short] = x[short] << WORD | fresh
            count += len(short)
    return x.tolist(), words[count:]
