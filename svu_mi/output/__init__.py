"""Results as files, and pages about them.

=================  ==============================  ===========================================
``light.png``      ``light_page.py``               the light (``svu light``), and all its files
``overview.png``   ``overview.py``                 entropy; all its files: ``write_entropy.py``
``guidance.png``   ``guidance_page.py``            next photographs; ``write_guidance.py``
``recovery.png``   ``recovery_page.py``            recovered textures; ``write_recovery.py``
``relit.png``      ``rerender.py``                 textures under another light
``report.html``    ``report/report.py``            one file to send; ``templates/report.html``
``check.html``     ``check_page.py``               fit of a capture; ``templates/check.html``
``compare.html``   ``compare/compare_page.py``     differences; ``templates/compare.html``
a browser          ``viewer/viewer.py``            ``svu view``
=================  ==============================  ===========================================

PNG pages are blocks of panels (``style.write_page``), drawn by ``panels.py``, also for notebooks.
HTML pages extend ``templates/base.html`` and use the macros of ``templates/parts.html``;
``html.py`` writes them. Report and viewer show the maps of ``surface_maps.py``, and ``svu compare``
those of ``result_maps.py``.
"""
