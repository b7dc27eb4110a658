"""Random messages: refused at worst, each with where it is wrong."""

import random

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from filter_service import errors
from filter_service.messages import (
    decode_request,
    encode,
)
from tests.mutated_messages import examples, mutated
from tests.unit.message_parts import (
    REQUESTS,
    as_bytes,
    profile_parts,
)

json_like = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=20)
    | st.binary(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.dictionaries(st.text(max_size=8), inner, max_size=5)
    ),
    max_leaves=12,
)
field_names = st.sampled_from(
    ["type", "version", *sorted({key for m in REQUESTS for key in m.fields()})]
)


def decodes_or_is_refused(parts):
    """Decode; only the protocol's own errors may come out, and each says where."""
    try:
        decode_request(parts)
    except errors.ProtocolError as error:
        assert error.field
        str(error)


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(REQUESTS), field_names, json_like, st.data())
def test_a_message_with_one_strange_field_never_does_more_than_be_refused(
    message, name, value, data
):
    parts = as_bytes(encode(message))
    header = msgpack.unpackb(parts[0])
    target = header
    inner = [v for v in header.values() if isinstance(v, dict) and v]
    inner += [v for v in header.get("views", []) if isinstance(v, dict)]
    if inner and data.draw(st.booleans()):
        target = data.draw(st.sampled_from(inner))
        name = data.draw(st.sampled_from(sorted(target)))
    target[name] = value
    decodes_or_is_refused([msgpack.packb(header), *parts[1:]])


@settings(max_examples=40, deadline=None)
@given(st.dictionaries(st.text(max_size=8), json_like, max_size=4))
def test_strange_profiles_never_do_more_than_be_refused(body):
    decodes_or_is_refused(profile_parts(msgpack.packb(body)))


def test_three_thousand_mutated_messages_never_do_more_than_be_refused():
    """Bytes and fields of another value, parts and fields that lack, and noise."""
    rng = random.Random(2)
    kinds = examples() + [as_bytes(encode(message)) for message in REQUESTS]
    for _ in range(3_000):
        decodes_or_is_refused(mutated(rng, rng.choice(kinds)))
