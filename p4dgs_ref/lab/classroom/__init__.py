"""The classroom: equations for students to write, the key, and a grader with held-back inputs.

A teacher's session in Python:

    from p4dgs_ref.lab import classroom
    classroom.hand_out("course")  # writes course/student, to hand out, and course/key
    grades = classroom.grade("anna", "ben", classroom="course")  # what two students handed in
    print(classroom.to_text(grades))  # the sums, and the points of every equation
    eq = classroom.load("course/student/offsets.py")  # the equation in a student's file
"""

from .grading import grade, rows_of, to_text
from .room import hand_out
from .student import load

__all__ = ["grade", "hand_out", "load", "rows_of", "to_text"]
