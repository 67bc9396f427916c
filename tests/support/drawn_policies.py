"""Parts of policies, drawn by hypothesis."""

from __future__ import annotations

from hypothesis import strategies as st

from sros_tool.policy.model import RIGHTS, Group, Qualifier


def drawn_groups(names: st.SearchStrategy[str]) -> st.SearchStrategy[Group]:
    """Groups of every kind, with one to three of the names."""

    def of(kind: str) -> st.SearchStrategy[Group]:
        either = st.none() | st.sampled_from(Qualifier)
        rights = st.tuples(either, either).map(
            lambda pair: tuple(
                (right, said) for right, said in zip(RIGHTS[kind], pair, strict=True) if said
            )
        )
        some = st.lists(names, min_size=1, max_size=3).map(tuple)
        return st.builds(Group, st.just(kind), rights.filter(bool), some)

    return st.sampled_from(sorted(RIGHTS)).flatmap(of)
