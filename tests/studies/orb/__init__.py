"""The evaluation of the Stanford-ORB data set: its protocol and its table.

``targets`` are the photographs that pictures are compared with, ``setting`` recovers and judges
one capture, ``run`` takes them all in turn; ``dataset`` renders a small set in the same layout.
"""
