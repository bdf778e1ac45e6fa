"""Many captures by one command: a list, steps in processes of their own, and a page of all."""

from svu_mi.batch.listing import Item as Item
from svu_mi.batch.listing import read_list as read_list
from svu_mi.batch.listing import require_apart as require_apart
from svu_mi.batch.page import write_index as write_index
from svu_mi.batch.record import Outcome as Outcome
from svu_mi.batch.shelf import Shelf as Shelf
from svu_mi.batch.steps import STEPS as STEPS
