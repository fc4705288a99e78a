"""The rules of the trigger, one policy in each file: its settings, and the condition that it tests.

``native/loop/trigger.c`` tests the condition at each measurement.
"""
