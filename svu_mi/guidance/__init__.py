"""Which photograph to take next: expected entropy of views (Sec. 5.1, Eq. 13)."""

from svu_mi.guidance.candidates import Candidates as Candidates
from svu_mi.guidance.next_view import next_best_view as next_best_view
from svu_mi.guidance.options import STRATEGIES as STRATEGIES
from svu_mi.guidance.options import GuidanceOptions as GuidanceOptions
from svu_mi.guidance.result import Guidance as Guidance
from svu_mi.guidance.result import Proposal as Proposal
