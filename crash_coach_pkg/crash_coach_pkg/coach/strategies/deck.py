"""Strategy ``deck``: an exact quota of crashes, dealt like cards."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from crash_coach_pkg.coach.strategies.base import Candidates, Draws, Strategy, StrategySettings

_SHUFFLE, _TURN = 1, 2  # streams of the draws; a turn's is _TURN + how many crash


def _cards(default: int, crashed: str) -> int:
    value: int = Field(
        default=default,
        ge=0,
        le=100,
        description=f"Episodes of each deck in which {crashed}.",
        json_schema_extra={"unit": "episodes"},
    )
    return value


class DeckSettings(StrategySettings):
    nobody: int = _cards(2, "nobody crashes")
    one: int = _cards(2, "one robot crashes")
    two: int = _cards(1, "two robots crash")
    three: int = _cards(0, "three robots crash")

    @model_validator(mode="after")
    def _has_cards(self) -> Self:
        if not any((self.nobody, self.one, self.two, self.three)):
            raise ValueError("a deck without cards: nobody, one, two and three are all 0")
        return self


class Deck(Strategy[DeckSettings]):
    """A deck says of as many episodes, in a shuffled order, how many robots crash in each. Whom a
    card concerns goes in turn: of n cards with k robots, each robot is in exactly k."""

    name: ClassVar[str] = "deck"
    summary: ClassVar[str] = "Fixed shares of episodes with 0, 1, 2, 3 crashed robots, in turn."
    Settings: ClassVar[type[StrategySettings]] = DeckSettings

    def __init__(self, settings: DeckSettings, candidates: Candidates) -> None:
        super().__init__(settings, candidates)
        counts = (settings.nobody, settings.one, settings.two, settings.three)
        # What the limits forbid is not in the deck; at worst nobody crashes.
        limit = candidates.n if candidates.triggered else candidates.most
        allowed = [(k, count) for k, count in enumerate(counts) if k <= limit]
        self._deck = tuple(k for k, count in allowed for _ in range(count)) or (0,)

    @property
    def rate(self) -> float:
        return sum(self._deck) / (len(self._deck) * max(1, self.candidates.n))

    @property
    def cap(self) -> int:
        return max(self._deck)

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        deck, place = divmod(episode, len(self._deck))
        cards = draws.of(_SHUFFLE, deck).permutation(self._deck)
        crashed = int(cards[place])
        if not crashed:
            return ()
        dealt = deck * self._deck.count(crashed) + int((cards[:place] == crashed).sum())
        turn, card = divmod(dealt, self.candidates.n)
        order = draws.of(_TURN + crashed, turn).permutation(self.candidates.n)
        chosen = (card * crashed + i for i in range(crashed))
        return tuple(sorted(int(order[i % self.candidates.n]) for i in chosen))
