"""Arithmetic that vectorises: exp2, log and the rules they are compiled by.

And a counter that threads share.
"""

from typing import Any

import numba as nb
from llvmlite import ir
from numba.extending import intrinsic

# Reassociation is left out where a result's last digits matter: it would undo the range reduction
# of exp2.
FAST = {"contract", "arcp", "nsz", "nnan", "ninf"}
REDUCE = FAST | {"reassoc"}

LOG2_E = 1.4426950408889634


@intrinsic
def as_float(typingctx: Any, bits: Any) -> Any:
    """The float64 with these bits, without leaving a SIMD loop."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return nb.types.float64(nb.types.int64), codegen


@intrinsic
def as_bits(typingctx: Any, value: Any) -> Any:
    """The bits of a float64 as an int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return nb.types.int64(nb.types.float64), codegen


@intrinsic
def split_single(typingctx: Any, x: Any) -> Any:
    """`split` of a positive normal float32: two numbers of that type."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        integer, single = ir.IntType(32), ir.FloatType()
        least = ir.Constant(integer, 1060439283)  # the bits of sqrt(1/2)
        bits = builder.sub(builder.bitcast(args[0], integer), least)
        k = builder.sitofp(builder.ashr(bits, ir.Constant(integer, 23)), single)
        m = builder.add(builder.and_(bits, ir.Constant(integer, 8388607)), least)
        parts = [k, builder.bitcast(m, single)]
        return context.make_tuple(builder, signature.return_type, parts)

    return nb.types.UniTuple(nb.types.float32, 2)(nb.types.float32), codegen


@intrinsic
def take_turn(typingctx: Any, turn: Any) -> Any:
    """The int64 that an array begins with, raised by one: no two threads get the same."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return nb.types.int64(turn), codegen


@intrinsic
def wide_vectors(typingctx: Any) -> Any:
    """Let the function that calls this use vectors of 512 bits where the processor has them.

    LLVM takes 256 on Intel's, since very wide ones once slowed the clock. For loops with many
    operations a pixel they are worth a fifth of the time; for others they can be a loss.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        # a set's own `add`: that of llvmlite's refuses attributes that are of one target
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return nb.types.none(), codegen


@nb.njit(fastmath=FAST, inline="always")
def exp2(x):
    """2^x for -1000 <= x < 1000 to 1.4e-14 relative, smaller x being taken for -1000.

    x = n + f with n the nearest integer, which adding 1.5 * 2^52 leaves in the sum's lowest bits;
    the polynomial of degree 9 that is nearest to 2^f on [-1/2, 1/2] (Remez); n added to the
    exponent's bits. Two degrees more would be right to rounding, at a tenth of an image's time.
    """
    x = max(x, -1000.0)
    shifted = x + 6755399441055744.0
    f = x - (shifted - 6755399441055744.0)
    p = 1.0150336495148618e-07
    p = p * f + 1.3259405603573696e-06
    p = p * f + 1.5252984839814557e-05
    p = p * f + 1.5403434948103528e-04
    p = p * f + 1.3333557617602426e-03
    p = p * f + 9.6181291920671934e-03
    p = p * f + 5.5504108668685624e-02
    p = p * f + 2.4022650695649653e-01
    p = p * f + 6.9314718055987100e-01
    p = p * f + 1.0000000000000127
    return as_float(as_bits(p) + (as_bits(shifted) << 52))


@nb.njit(fastmath=FAST, inline="always")
def split(x):
    """k and m in [0.7, 1.41] of a positive normal number m 2^k."""
    bits = as_bits(x)
    k = (bits - 4604544271217802189) >> 52  # exponent, counted from sqrt(1/2)
    return k, as_float(bits - (k << 52))


@nb.njit(fastmath=FAST, inline="always")
def log(x):
    """log(x) of a positive normal number to 3e-16 (absolute near 1).

    The mantissa m by bits, then 2 artanh(s) with s = (m - 1) / (m + 1): 2 s + 2 s^3 p(s^2), p being
    the polynomial of degree 6 nearest to 1/3 + z/5 + z^2/7 + ... (Remez, 5e-18 of the result).
    """
    k, m = split(x)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    w = z * z
    p = 9.0914466202426646721e-02 + z * 7.6657981172986236734e-02 + w * 7.3089406919315180756e-02
    q = 1.4285714313200197706e-01 + z * 1.1111105536283593608e-01
    p = 3.3333333333333348644e-01 + z * 1.9999999999949222791e-01 + w * (q + w * p)
    return k * 6.93147180369123816490e-01 + (
        2.0 * s + (2.0 * s * z * p + k * 1.90821492927058770002e-10)
    )


@nb.njit(fastmath=FAST, inline="always")
def log2(x):
    """log2(x) of a positive normal number to 3e-14 relative: x^-b = 2^(-b log2(x)) to 1e-14 of 1.

    As `log`, with a polynomial of degree 5 in s^2 that is nearest to 2 artanh(s) / (s ln 2), half
    of its terms summed beside the others.
    """
    bits = as_bits(x)
    k = (bits - 4604544271217802189) >> 52
    m = as_float(bits - (k << 52))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    w = z * z
    p = 0.57707794194572192836 + 0.41220928743393731031 * z
    p = p + w * (0.31990445341646511768 + 0.28291595555712129029 * z)
    p = 2.8853900817778481702 + 0.96179669411524015832 * z + w * p
    return k + s * p
