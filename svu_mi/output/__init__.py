"""Result files, and pages that show them.

=================  ==============================  ===========================================
``light.png``      ``light_page.py``               estimated light, and the files of ``svu light``
``overview.png``   ``overview.py``                 entropy; files: ``write_entropy.py``
``guidance.png``   ``guidance_page.py``            proposed views; files: ``write_guidance.py``
``recovery.png``   ``recovery_page.py``            textures; files: ``write_recovery.py``
``relit.png``      ``rerender.py``                 renders under another light
``report.html``    ``report/report.py``            report; ``templates/report.html``
``check.html``     ``check_page.py``               fit of a capture; ``templates/check.html``
``compare.html``   ``compare/compare_page.py``     differences; ``templates/compare.html``
browser            ``viewer/viewer.py``            ``svu view``
=================  ==============================  ===========================================

PNG pages are blocks of panels (``style.write_page``), drawn by ``panels.py``, which also serves
notebooks. HTML pages extend ``templates/base.html``, use the macros of ``templates/parts.html``
and are written by ``html.py``. ``surface_maps.py`` has the maps of report and viewer,
``result_maps.py`` the maps of ``svu compare``.
"""
