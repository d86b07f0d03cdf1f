"""Elementary functions of `decimal` numbers, right to the last few digits of the current context.

The standard library has +, -, *, /, sqrt, exp and ln. Everything else is made here from series and
one continued fraction, so that nothing is shared with the libraries that it judges. Where a formula
cancels, the digits that it loses are added first (`guard`). Where two formulas meet, both are right
on both sides.
"""

from contextlib import contextmanager
from decimal import MAX_EMAX, MIN_EMIN, ROUND_HALF_EVEN, Context, Decimal, getcontext, localcontext
from functools import lru_cache, wraps

DIGITS = 60  # of a value that may be trusted
WORKING = 160  # of intermediate results: difference quotients lose two thirds of them
# With these exponents e^(-10^11) does not underflow.
CONTEXT = Context(prec=WORKING, Emin=MIN_EMIN, Emax=MAX_EMAX)

HALF = Decimal("0.5")
SERIES = 8  # distance of a tail: below, a power series; from here on, a continued fraction


def working():
    """A `with` block of WORKING digits."""
    return localcontext(CONTEXT)


@contextmanager
def guard(digits):
    """A `with` block with that many more digits than the current context."""
    with localcontext() as context:
        context.prec += max(0, digits)
        yield


def remembered(function):
    """Cache results: difference quotients repeat what the moved input does not change."""
    kept = lru_cache(1 << 15)(lambda x, precision: function(x))

    @wraps(function)
    def ask(x):
        return kept(x, getcontext().prec)

    return ask


def sum_of(terms):
    """The sum of a series with falling terms, up to the first that no longer changes it."""
    total = Decimal(0)
    for term in terms:
        before, total = total, total + term
        if total == before:
            return total


# --- exponentials and logarithms -----------------------------------------------------------------
@remembered
def exp(x):
    return x.exp()


@remembered
def log(x):
    return x.ln()


@remembered
def expm1(x):
    """e^x - 1 without the difference where x is small."""
    if abs(x) >= HALF:
        with guard(2):
            result = exp(x) - 1
        return +result
    return sum_of(_powers_over_factorials(x, x, 1, 1))


def _powers_over_factorials(term, factor, n, step):
    """The terms of exp (step 1) or of sin and cos (step 2).

    Each is the one before times factor / ((n + 1) ... (n + step)).
    """
    while True:
        yield term
        for i in range(n + 1, n + step + 1):
            term /= i
        term, n = term * factor, n + step


@remembered
def log1p(x):
    """log(1 + x), by 2 artanh(x / (2 + x)) where x is small."""
    if abs(x) > Decimal("0.25"):
        return log(1 + x)
    ratio = x / (2 + x)
    return 2 * sum_of(_odd_powers(ratio, ratio * ratio))


def _odd_powers(power, square):
    n = 1
    while True:
        yield power / n
        power, n = power * square, n + 2


def sigmoid(x):
    """1 / (1 + e^-x), computed from the exponential that is below one."""
    tail = exp(-abs(x))
    return (1 if x >= 0 else tail) / (1 + tail)


def tanh(x):
    drop = expm1(-2 * abs(x))
    return (-drop / (2 + drop)).copy_sign(x)


# --- circular functions --------------------------------------------------------------------------
@lru_cache(64)
def _pi(digits):
    """Machin's formula, 16 arctan(1/5) - 4 arctan(1/239), in integers."""
    one = 10 ** (digits + 10)

    def arctan_of_inverse(n):
        total, power, k = 0, one // n, 0
        while power:
            total += (-1) ** k * (power // (2 * k + 1))
            power, k = power // (n * n), k + 1
        return total

    scaled = 16 * arctan_of_inverse(5) - 4 * arctan_of_inverse(239)
    return Decimal(f"{scaled}E-{digits + 10}")


def pi():
    """Pi with all digits of the context."""
    return +_pi(getcontext().prec)


def _quadrant(x):
    """x = n pi/2 + r with |r| <= pi/4, as (n mod 4, r).

    The subtraction loses the digits of the whole turns, so they are added first.
    """
    with guard(max(0, x.adjusted()) + 40):
        n = (x * 2 / pi()).to_integral_value(ROUND_HALF_EVEN)
        rest = x - n * pi() / 2
        turns = int(n % 4) % 4
    return turns, +rest


@remembered
def sin_cos(x):
    """(sin x, cos x), both with all digits, also beside their zeros."""
    turns, r = _quadrant(x)
    square = -r * r
    s, c = (
        sum_of(_powers_over_factorials(r, square, 1, 2)),
        sum_of(_powers_over_factorials(Decimal(1), square, 0, 2)),
    )
    return ((s, c), (c, -s), (-s, -c), (-c, s))[turns]


def sin(x):
    return sin_cos(x)[0]


def cos(x):
    return sin_cos(x)[1]


# --- the Gaussian --------------------------------------------------------------------------------
@remembered
def mills(z):
    """The tail beyond z >= 0 over the density at z: (1 - Phi(z)) / phi(z)."""
    if z < SERIES:
        with guard(20):  # a difference of nearly equal numbers, which cancel by at most e^32
            result = exp(z * z / 2) * (pi() / 2).sqrt() - sum_of(_odd_double_factorials(z))
        return +result
    # 1 / (z + 1 / (z + 2 / (z + 3 / ...))). Successive convergents P/Q lie on either side of the
    # value, which proves that the loop may stop.
    allowed = Decimal(10) ** -getcontext().prec
    with guard(10):
        P, Q, P_next, Q_next, n = Decimal(0), Decimal(1), Decimal(1), z, 1
        while abs(P_next * Q - P * Q_next) > allowed * P_next * Q:
            for _ in range(8):
                P, Q, P_next, Q_next = P_next, Q_next, z * P_next + n * P, z * Q_next + n * Q
                n += 1
        result = P_next / Q_next
    return +result


def _odd_double_factorials(z):
    """z + z^3 / 3 + z^5 / (3 5) + ...: the integral of the density from 0 to z over that at z."""
    term, n = z, 1
    while True:
        yield term
        n += 2
        term = term * z * z / n


def tail(z):
    """1 - Phi(z) for z >= 0."""
    return exp(-z * z / 2) / (2 * pi()).sqrt() * mills(z)


def Phi(z):
    """The distribution function of the standard Gaussian."""
    return tail(-z) if z <= 0 else 1 - tail(z)


def erfc(x):
    with guard(5):
        t = 2 * tail(abs(x) * Decimal(2).sqrt())
        result = t if x >= 0 else 2 - t
    return +result


def log_mass(z, w):
    """log(Phi(z + w/2) - Phi(z - w/2)) for w > 0.

    On one side of the mean it is computed from scaled tails, so that nothing underflows.
    """
    z = abs(z)
    # The digits that the two edges, and their tails, have in common.
    lost = max(0, z.adjusted()) - w.adjusted() + 5
    with guard(lost):
        low, high = z - w / 2, z + w / 2
        if low < 0:
            result = log1p(-tail(-low) - tail(high))
        else:  # high^2 - low^2 = 2 z w
            result = log(mills(low) - exp(-z * w) * mills(high)) - low * low / 2 - log(2 * pi()) / 2
    return +result
