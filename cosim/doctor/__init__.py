"""What a machine grants, and what that means for a run: measured, judged, and shown.

:mod:`cosim.doctor.machine_measures` measures, with processes of their own
(:mod:`cosim.doctor.probe`); :mod:`cosim.doctor.findings` turns numbers into verdicts, and does
nothing else.
"""
