MODULE stream_state
  ! Task T_STATE: sends JOINT_POSITION, then STATUS, every STATE_PERIOD; to a client that sends PING also BOARD_STATE.
  ! The signals are system outputs (config/parameters.md).

  VAR socketdev server;
  VAR socketdev client;
  VAR num sequence := 0;
  VAR bool has_heartbeat;
  ! Time since the last PING.
  VAR clock silence;

  PROC main()
    accept_client server, client, STATE_PORT, WAIT_MAX;
    has_heartbeat := FALSE;
    WHILE TRUE DO
      send_joints;
      send_status;
      read_heartbeat;
      IF has_heartbeat THEN
        send_board;
        ! A client that is lost without a word keeps the connection open: the next client must not wait for it.
        IF ClkRead(silence) > CLIENT_TIMEOUT ExitCycle;
      ENDIF
      WaitTime STATE_PERIOD;
    ENDWHILE
  ERROR
    IF ERRNO = ERR_SOCK_CLOSED OR ERRNO = ERR_SOCK_TIMEOUT ExitCycle;
    TPWrite "State server stopped, ERRNO " \Num:=ERRNO;
    Stop;
  ENDPROC

  ! Whatever a client of this server sends is its heartbeat.
  PROC read_heartbeat()
    VAR rawbytes heartbeat;
    IF SocketPeek(client) = 0 RETURN;
    SocketReceive client \RawData:=heartbeat \Time:=CLIENT_TIMEOUT;
    ClkStop silence;
    ClkReset silence;
    ClkStart silence;
    has_heartbeat := TRUE;
  ERROR
    RAISE;
  ENDPROC

  ! 10 joints as in REP-I0006, 6 for each unit where that is more; joints that no arm has are 0.
  PROC send_joints()
    VAR rawbytes body;
    VAR jointtarget here;
    PackRawBytes sequence, body, 1 \IntX:=DINT;
    FOR u FROM 1 TO UNITS DO
      here := CJointT(\TaskName:=MOTION_TASKS{u});
      pack_angle here.robax.rax_1, body;
      pack_angle here.robax.rax_2, body;
      pack_angle here.robax.rax_3, body;
      pack_angle here.robax.rax_4, body;
      pack_angle here.robax.rax_5, body;
      pack_angle here.robax.rax_6, body;
    ENDFOR
    ! With STEP none is packed where 6 * UNITS is 10 or more; without it FOR counts down.
    FOR i FROM 6 * UNITS + 1 TO 10 STEP 1 DO
      pack_angle 0, body;
    ENDFOR
    send_message client, JOINT_POSITION, TOPIC, 0, body;
    sequence := (sequence + 1) MOD 1000000;
  ERROR
    RAISE;
  ENDPROC

  PROC pack_angle(num angle, VAR rawbytes body)
    PackRawBytes angle / DEGREES, body, RawBytesLen(body) + 1 \Float4;
  ENDPROC

  ! drives_powered, e_stopped, error_code, in_error, in_motion, mode, motion_possible; mode 1 manual, 2 auto.
  PROC send_status()
    VAR rawbytes body;
    VAR num mode := 1;
    VAR num possible := 0;
    IF OpMode() = OP_AUTO mode := 2;
    IF DOutput(doMotorsOn) = 1 AND DOutput(doRapidRunning) = 1 AND DOutput(doExecutionError) = 0 possible := 1;
    pack_integer DOutput(doMotorsOn), body;
    pack_integer DOutput(doEmergencyStop), body;
    pack_integer 0, body;
    pack_integer DOutput(doExecutionError), body;
    pack_integer moving(), body;
    pack_integer mode, body;
    pack_integer possible, body;
    send_message client, STATUS, TOPIC, 0, body;
  ERROR
    RAISE;
  ENDPROC

  ! System output Mechanical Unit Not Moving, a signal for each unit; those of units that do not exist are not read.
  FUNC num moving()
    IF DOutput(doNotMoving1) = 0 RETURN 1;
    IF UNITS > 1 AND DOutput(doNotMoving2) = 0 RETURN 1;
    IF UNITS > 2 AND DOutput(doNotMoving3) = 0 RETURN 1;
    IF UNITS > 3 AND DOutput(doNotMoving4) = 0 RETURN 1;
    RETURN 0;
  ENDFUNC

  ! 16 inputs and 16 outputs, bit 0 is number 1: group signals on the board, as a DSQC 652.
  PROC send_board()
    VAR rawbytes body;
    pack_integer GInput(giBoard), body;
    pack_integer GOutput(goBoard), body;
    send_message client, BOARD_STATE, TOPIC, 0, body;
  ERROR
    RAISE;
  ENDPROC

  PROC pack_integer(num value, VAR rawbytes body)
    PackRawBytes value, body, RawBytesLen(body) + 1 \IntX:=DINT;
  ENDPROC

ENDMODULE
