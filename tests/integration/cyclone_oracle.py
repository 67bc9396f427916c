"""Ask Cyclone DDS, many times, what signed documents let an identity do.

Cases are {"identity", "documents", "domain", "zone",
"questions": [[verb, topic, [partition...]]...], "peer": null or [identity, documents], "seconds"},
where identity and documents are folders.  The answer to each is
{"end": "refused" | "joined" | "crashed" | "hung" | "failed" | "peer refused" | "peer crashed" |
"peer hung", "answers", "log"};
the answers are denied, invalid (the name), created, and with a peer: matched (and heard), unmatched
or peer denied.

Each case has processes of its own: a crash is an answer, and two participants of one process would
share the permissions of the first.  The library is loaded once, before they are forked.
"""

from __future__ import annotations

import ctypes
import faulthandler
import json
import os
import select
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sros_tool.parallel import end_with_parent
from sros_tool.runtime.cyclone import (
    STRING_TYPE,
    CycloneLibrary,
    SampleInfo,
    StringSample,
    TopicDescriptor,
    load_cyclone,
    security_properties,
)

PATIENCE = 120.0
OPS = (ctypes.c_uint32 * 3)(0x01 << 24 | 0x05 << 16, 0, 0)

REFUSALS = {-13: "denied", -3: "invalid"}
"""NOT_ALLOWED_BY_SECURITY, and BAD_PARAMETER, which is about the name of the topic."""

Case = dict[str, Any]
Report = dict[str, Any]
IGNORE_OWN_PARTICIPANT = 1  # a reader and a writer of one process would else meet each other


def answers(cases: Sequence[Case]) -> list[Report]:
    """The answers to cases, in their order; for a process of its own."""
    with suppress(PermissionError):
        os.setsid()  # OpenSSL asks on the terminal for the pass phrase of an encrypted part
    library = load_cyclone()
    declare(library.api)
    os.dup2(2, 1)  # Cyclone DDS prints what it does not understand of XML
    return [run(library, case) for case in cases]


def declare(api: Any) -> None:
    """The functions that only this program calls."""
    strings = ctypes.POINTER(ctypes.c_char_p)
    api.dds_qset_partition.argtypes = [ctypes.c_void_p, ctypes.c_uint32, strings]
    api.dds_qset_partition.restype = None
    api.dds_qset_ignorelocal.argtypes = [ctypes.c_void_p, ctypes.c_int]
    api.dds_qset_ignorelocal.restype = None
    for name in ("dds_create_publisher", "dds_create_subscriber"):
        getattr(api, name).argtypes = [ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p]
        getattr(api, name).restype = ctypes.c_int32


# ── processes ──────────────────────────────────────────────────────────────────────────────


def run(library: CycloneLibrary, case: Case) -> Report:
    """The answer to one case."""
    with Process(lambda say: take_part(library, case, say)) as own:
        report = own.report()
        if report is None:
            return {"end": own.ended(), "answers": [], "log": ""}
        wanted = [i for i, answer in enumerate(report["answers"]) if answer == "created"]
        if not case["peer"] or not wanted:
            return report
        identity, documents = case["peer"]
        mirrored = [
            ["subscribe" if verb == "publish" else "publish", topic, partitions]
            for verb, topic, partitions in (case["questions"][i] for i in wanted)
        ]
        other = {
            **case,
            "identity": identity,
            "documents": documents,
            "questions": mirrored,
            "again": True,
        }
        with Process(lambda say: take_part(library, other, say)) as peer:
            opened = peer.report()
            if opened is not None and opened["end"] != "joined":
                return {"end": "peer refused", "answers": [], "log": opened["log"]}
            found = peer.report() if opened else None
            if opened is None or found is None:
                return {"end": f"peer {peer.ended()}", "answers": [], "log": ""}
            both = own.report()
            if both is None:
                return {"end": own.ended(), "answers": [], "log": ""}
        for i, answer, mine, others in zip(
            wanted, opened["answers"], both["answers"], found["answers"], strict=True
        ):
            matched = "matched" if mine and others else "unmatched"
            report["answers"][i] = matched if answer == "created" else "peer denied"
        return report


class Process:
    """A forked process; it lives until the block ends, so that others still find it."""

    def __init__(self, body: Callable[[Callable[[Report], None]], None]) -> None:
        self._end, write_end = os.pipe()
        self._id = os.fork()
        if self._id:
            os.close(write_end)
            return
        try:
            end_with_parent()
            faulthandler.disable()  # that the library crashes is an answer, and no news
            os.close(self._end)

            def say(report: Report) -> None:
                os.write(write_end, json.dumps(report).encode() + b"\n")

            body(say)
            signal.pause()
        except BaseException:
            traceback.print_exc()
        finally:  # a forked child must never return into its caller
            os._exit(1)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.ended()
        os.close(self._end)

    def report(self) -> Report | None:
        """The next line that it says; None if it ended, or says nothing for long."""
        said = b""
        end = time.monotonic() + PATIENCE
        while not said.endswith(b"\n"):
            if not select.select([self._end], [], [], max(0.0, end - time.monotonic()))[0]:
                return None
            more = os.read(self._end, 1)
            if not more:
                return None
            said += more
        return dict(json.loads(said))

    def ended(self) -> str:
        """End it, and tell how it ended unless it was alive."""
        if not self._id:
            return ""
        with suppress(ProcessLookupError):
            os.kill(self._id, signal.SIGKILL)
        _, status = os.waitpid(self._id, 0)
        self._id = 0
        if os.WIFEXITED(status):
            return "failed"
        return "hung" if os.WTERMSIG(status) == signal.SIGKILL else "crashed"


# ── a participant ──────────────────────────────────────────────────────────────────────────


def take_part(library: CycloneLibrary, case: Case, say: Callable[[Report], None]) -> None:
    """Join, open what is asked and say so; with a peer, say then which of these has found it.

    With "again", everything is opened once more when the handshake is over: an endpoint that was
    discovered before it may stay unmatched although the same one opened later is matched.
    """
    os.environ["TZ"] = case["zone"]
    time.tzset()
    api = library.api
    with qos_of(api) as qos:
        for name, value in properties(library, case).items():
            api.dds_qset_prop(qos, name.encode(), value.encode())
        participant = api.dds_create_participant(case["domain"], qos, None)
    if participant < 0:
        say({"end": "refused", "answers": [], "log": "; ".join(library.log.messages())})
        return
    topics: dict[str, int] = {}
    ends = [
        (verb, open_end(api, participant, topics, verb, topic, partitions))
        for verb, topic, partitions in case["questions"]
    ]
    answers = ["created" if end >= 0 else REFUSALS.get(end, f"error {end}") for _, end in ends]
    say({"end": "joined", "answers": answers, "log": "; ".join(library.log.messages())})
    if case["peer"]:
        made = [(asked, [end]) for asked, (_, end) in zip(case["questions"], ends, strict=True)]
        made = [each for each in made if each[1][0] >= 0]
        met = [False] * len(made)
        start = time.monotonic()
        again, said = bool(case.get("again")), False
        while True:  # also once it said it: the other side may still wait
            met = [meet(api, *each) or seen for seen, each in zip(met, made, strict=True)]
            passed = time.monotonic() - start
            if again and passed > case["seconds"] / 3:
                again = False
                for asked, same in made:
                    same.append(open_end(api, participant, topics, *asked))
            if not said and (all(met) or passed > case["seconds"]):
                said = True
                say({"answers": met})
            time.sleep(0.02)


def meet(api: Any, asked: list[Any], ends: list[int]) -> bool:
    """Whether one of several endpoints that ask the same has found what it needs."""
    found = [meets(api, asked[0], end) for end in ends]  # every writer has to write
    return any(found)


def properties(library: CycloneLibrary, case: Case) -> dict[str, str]:
    """As the RMW would give them, whether the files are there or not."""
    folders: dict[str, str] = {
        "governance.p7s": case["documents"],
        "permissions.p7s": case["documents"],
    }
    found = {}
    for name, value in security_properties(Path(case["whole"]), library.plugins).items():
        if not value.startswith("file:"):
            found[name] = value
            continue
        file = Path(value).name
        path = Path(folders.get(file) or case["identity"], file)
        if file != "crl.pem":
            found[name] = f"file:{path}"
    if (Path(case["identity"]) / "crl.pem").exists():
        revoked = "org.eclipse.cyclonedds.sec.auth.crl"
        found[revoked] = f"file:{case['identity']}/crl.pem"
    return found


def open_end(
    api: Any,
    participant: int,
    topics: dict[str, int],
    verb: str,
    topic: str,
    partitions: list[str],
) -> int:
    """A writer or a reader, or what is below zero."""
    if topics.get(topic, -1) < 0:
        with qos_of(api) as qos:
            described = ctypes.byref(descriptor())
            topics[topic] = api.dds_create_topic(participant, described, topic.encode(), qos, None)
    if topics[topic] < 0:
        return topics[topic]
    writes = verb == "publish"
    with qos_of(api) as qos:
        if partitions:
            names = (ctypes.c_char_p * len(partitions))(*(each.encode() for each in partitions))
            api.dds_qset_partition(qos, len(partitions), names)
        make = api.dds_create_publisher if writes else api.dds_create_subscriber
        group = make(participant, qos, None)
    if group < 0:
        return int(group)
    create = api.dds_create_writer if writes else api.dds_create_reader
    with qos_of(api) as qos:
        api.dds_qset_ignorelocal(qos, IGNORE_OWN_PARTICIPANT)
        return int(create(group, topics[topic], qos, None))


def meets(api: Any, verb: str, end: int) -> bool:
    """Write if it is a writer, and tell whether it has found readers; whether a reader hears."""
    if verb == "publish":
        sample = StringSample(b"Hello")
        api.dds_write(end, ctypes.byref(sample))
        return bool(api.dds_get_matched_subscriptions(end, None, 0) > 0)
    samples, infos = (ctypes.c_void_p * 1)(), (SampleInfo * 1)()
    taken = api.dds_take(end, samples, infos, 1, 1)
    if taken > 0:
        api.dds_return_loan(end, samples, taken)
    return bool(taken > 0)


def descriptor() -> TopicDescriptor:
    return TopicDescriptor(
        size=ctypes.sizeof(StringSample),
        align=ctypes.alignment(StringSample),
        flags=1,
        type_name=STRING_TYPE.encode(),
        op_count=2,
        ops=OPS,
        meta=b"",
    )


@contextmanager
def qos_of(api: Any) -> Iterator[Any]:
    qos = api.dds_create_qos()
    try:
        yield qos
    finally:
        api.dds_delete_qos(qos)
