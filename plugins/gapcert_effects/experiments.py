"""What would tell similar effects apart: sentences that several effects share."""

VARY_SPEED = (
    "let the coordinate move over a wide range of speeds, from near rest to its fastest: the laws differ in the exponent"
)
REST = "start and stop often, and creep through zero speed: only dry friction keeps its size there"
CREEP = "creep slowly back and forth over short ways: the laws differ before the joint breaks away"
BOTH_WAYS = "move in both directions: friction turns its sign with the velocity, a constant force does not"
LEVELS = "hold several input levels, zero included: only a wrong gain grows with the input"
LOADS = "repeat one motion under different loads: only friction of the load grows with them"
PLACES = "hold still at several places over the whole range: the laws differ in how the force depends on the place"
FREE_DECAY = "release it far from rest, without input, and let it swing out"
FAST = "play fast inputs, steps or a chirp up to the bandwidth: the phase of a delay falls in proportion to the frequency"
SMALL_AND_LARGE = "play one signal small, then large: a limit shows in the large one only, a dead zone in the small one"
REVERSALS = "reverse the input away from zero: play stays there, a dead zone does not"
SECOND = "measure a second output beside this one: a late input shows in both, a late sensor in one"
SHAKE_AND_HOLD = "shake it fast, then hold it still at several places: inertia shows in the one, weight in the other"
SLIDE = "let the body slide to rest on a level surface, from several speeds and on several of its faces"
DROP = "drop the body flat, without sliding, from several heights"
