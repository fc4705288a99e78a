"""What a machine grants, and what that means for a run: measured, judged, and shown.

:mod:`cosim.doctor.measure` measures, with processes of their own (:mod:`cosim.doctor.probe`);
:mod:`cosim.doctor.judge` turns numbers into verdicts, and does nothing else.
"""
