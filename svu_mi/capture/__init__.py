"""What was seen: scene, sensors, photographs, masks, exposures."""

from svu_mi.capture.loading import has_photographs as has_photographs
from svu_mi.capture.loading import load_capture as load_capture
from svu_mi.capture.loading import photographs_of as photographs_of
from svu_mi.capture.record import Capture as Capture
from svu_mi.capture.rendering import render_capture as render_capture
