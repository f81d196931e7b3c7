MODULE latency
  ! Measures on the controller itself, without any computer: how late is axis 1 behind a sine of move instructions, and
  ! how many instructions return before the axis moves. Load it alone into a motion task; PP to Main; start. The arm turns
  ! axis 1 by 22.5 degrees, back and forth, for 12 s: keep clear. The file is read by `lag_of_log` (docs/experiments.md).

  CONST num RATE := 30;
  CONST num PERIOD := 2;
  ! Half of pi/8 rad, degrees.
  CONST num AMPLITUDE := 11.25;
  CONST num MOVES := 360;
  ! Degrees: more is a motion, less is noise.
  CONST num MOVED := 0.02;
  CONST zonedata ZONE := z10;
  CONST string FILE_NAME := "latency.csv";

  VAR clock elapsed;
  VAR num at{360};
  VAR num command{360};
  VAR num actual{360};

  PROC main()
    VAR jointtarget begin;
    begin := CJointT();
    ClkReset elapsed;
    ClkStart elapsed;
    FOR i FROM 1 TO MOVES DO
      move_one i, begin;
    ENDFOR
    ClkStop elapsed;
    write_log;
    tell_first_motion begin;
    Stop;
  ENDPROC

  PROC move_one(num i, jointtarget begin)
    VAR jointtarget next;
    VAR jointtarget here;
    next := begin;
    next.robax.rax_1 := begin.robax.rax_1 + AMPLITUDE * (1 - Cos(360 * i / (RATE * PERIOD)));
    ! Time and position before the instruction: it waits while the queue of the motion planner is full.
    here := CJointT();
    at{i} := ClkRead(elapsed);
    command{i} := next.robax.rax_1;
    actual{i} := here.robax.rax_1;
    MoveAbsJ next \NoEOffs, v1000 \T:=1 / RATE, ZONE, tool0;
  ENDPROC

  PROC write_log()
    VAR iodev file;
    Open "HOME:" \File:=FILE_NAME, file \Write;
    Write file, "time_s,command,actual";
    FOR i FROM 1 TO MOVES DO
      Write file, NumToStr(at{i}, 4) + "," + NumToStr(command{i}, 4) + "," + NumToStr(actual{i}, 4);
    ENDFOR
    Close file;
  ENDPROC

  PROC tell_first_motion(jointtarget begin)
    FOR i FROM 1 TO MOVES DO
      IF Abs(actual{i} - begin.robax.rax_1) > MOVED THEN
        TPWrite "Move instructions before axis 1 moved: " \Num:=i - 1;
        TPWrite "Seconds before axis 1 moved: " \Num:=at{i};
        RETURN;
      ENDIF
    ENDFOR
    TPWrite "Axis 1 did not move";
  ENDPROC
ENDMODULE
