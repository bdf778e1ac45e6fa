"""What was seen: scene, sensors, photographs, masks, exposures."""

from svu_mi.capture.loading import load_capture as load_capture
from svu_mi.capture.record import Capture as Capture
from svu_mi.capture.rendering import render_capture as render_capture
