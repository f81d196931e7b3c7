MODULE stream_server
  ! Task T_STREAM: receives points by Simple Message and offers them to the motion tasks.
  ! Streaming: sequence 0, 1, 2...; each point is executed as it comes, and the reply follows its acceptance.
  ! Downloading: sequence -1, 1, 2... -3; the trajectory is executed when the last point is there.
  ! Sequence -4 stops, in both. PING is answered: a client that sends it is lost when it falls silent.

  CONST num START_DOWNLOAD := -1;
  CONST num END_TRAJECTORY := -3;
  CONST num STOP_TRAJECTORY := -4;
  CONST num LONGEST_MESSAGE := 1023;

  VAR socketdev server;
  VAR socketdev client;
  VAR errnum ERR_MESSAGE := -1;
  VAR rawbytes message;
  VAR num length;
  VAR bool connected;
  ! Time without a byte after which the client is lost, s.
  VAR num silence_limit;
  VAR bool downloading := FALSE;
  VAR num collected := 0;
  ! All motion tasks have answered the last stop. Until then no arm moves, and no point is taken.
  VAR bool stop_confirmed := FALSE;
  ! Where the arms are commanded, degrees: a point is refused if it asks for too high a speed from there.
  VAR robjoint last{4};

  PROC main()
    VAR errnum reason;
    IF ERR_MESSAGE = -1 BookErrNo ERR_MESSAGE;
    connected := FALSE;
    IF MOTORS_OFF_TIME > 0 THEN
      accept_client server, client, MOTION_PORT, MOTORS_OFF_TIME;
    ELSE
      accept_client server, client, MOTION_PORT, WAIT_MAX;
    ENDIF
    connected := TRUE;
    silence_limit := IDLE_TIMEOUT;
    begin_at_rest;
    WHILE TRUE DO
      serve_message;
    ENDWHILE
  ERROR
    reason := ERRNO;
    ! The client is gone or silent, its bytes are no message, or this task cannot go on: no arm goes on without them.
    TPWrite "Streaming: the arms stop, ERRNO " \Num:=reason;
    stop_motion;
    ! No client for MOTORS_OFF_TIME: a system input switches the motors off (config/parameters.md).
    IF reason = ERR_SOCK_TIMEOUT AND NOT connected PulseDO \PLength:=ORDER_PULSE, doOrderMotorsOff;
    IF reason = ERR_SOCK_CLOSED OR reason = ERR_SOCK_TIMEOUT OR reason = ERR_MESSAGE ExitCycle;
    Stop;
  ENDPROC

  PROC serve_message()
    VAR rawbytes empty;
    VAR num type;
    VAR num comm_type;
    VAR num code;
    VAR num value;
    receive_bytes client, 4, message, silence_limit;
    UnpackRawBytes message, 1, length \IntX:=DINT;
    IF length < 12 OR length > LONGEST_MESSAGE RAISE ERR_MESSAGE;
    receive_bytes client, length, message, silence_limit;
    UnpackRawBytes message, 1, type \IntX:=DINT;
    UnpackRawBytes message, 5, comm_type \IntX:=DINT;
    code := FAILURE;
    IF type = PING THEN
      silence_limit := CLIENT_TIMEOUT;
      code := SUCCESS;
    ENDIF
    IF type = MOTORS AND length = 16 order_motors code;
    IF type = BOARD_OUTPUTS AND length = 16 THEN
      UnpackRawBytes message, 13, value \IntX:=DINT;
      IF value >= 0 AND value <= 65535 THEN
        SetGO goBoard, value;
        code := SUCCESS;
      ENDIF
    ENDIF
    ! Only the type tells a 12-joint JOINT_POSITION from a 10-joint JOINT_TRAJ_PT: both are 64 long.
    IF type = JOINT_TRAJ_PT AND length >= 24 + 24 * UNITS AND length MOD 4 = 0 take_point code;
    IF comm_type = REQUEST send_message client, type, REPLY, code, empty;
  ERROR
    RAISE;
  ENDPROC

  ! Motors On or Motors Off by a system input. In manual mode the enabling device alone switches motors on.
  PROC order_motors(INOUT num code)
    VAR num value;
    UnpackRawBytes message, 13, value \IntX:=DINT;
    IF value = 0 THEN
      PulseDO \PLength:=ORDER_PULSE, doOrderMotorsOff;
      code := SUCCESS;
    ELSEIF value = 1 AND OpMode() = OP_AUTO AND DOutput(doEmergencyStop) = 0 THEN
      PulseDO \PLength:=ORDER_PULSE, doOrderMotorsOn;
      code := SUCCESS;
    ENDIF
  ERROR
    RAISE;
  ENDPROC

  ! A joint message as a whole; code becomes SUCCESS once the point is accepted.
  PROC take_point(INOUT num code)
    VAR num sequence;
    VAR num duration;
    VAR num at;
    VAR bool accepted := FALSE;
    VAR robjoint point{4};
    UnpackRawBytes message, 13, sequence \IntX:=DINT;
    IF sequence = STOP_TRAJECTORY THEN
      stop_motion;
      code := SUCCESS;
      RETURN;
    ENDIF
    ! Behind the joints, however many: velocity, duration.
    at := length - 3;
    UnpackRawBytes message, at, duration \Float4;
    IF duration < SHORTEST_MOVE duration := SHORTEST_MOVE;
    read_joints point;
    ! A new trajectory takes the place of the one under way.
    ! A motion task that was started anew has lost its queue, and its arm is not at the last point.
    IF sequence = START_DOWNLOAD OR NOT (stop_confirmed AND all_have_stopped()) stop_motion;
    IF NOT stop_confirmed RETURN;
    IF sequence = START_DOWNLOAD THEN
      downloading := TRUE;
    ELSEIF sequence = 0 AND downloading THEN
      begin_at_rest;
    ENDIF
    IF NOT is_slow_enough(point, duration) RETURN;
    IF downloading THEN
      IF collected = MOST_POINTS RETURN;
      collect point, duration;
      IF sequence <> END_TRAJECTORY THEN
        code := SUCCESS;
        RETURN;
      ENDIF
      downloading := FALSE;
      path_points := collected;
      collected := 0;
    ELSE
      path_points := 0;
      target_duration := duration;
      targets := point;
    ENDIF
    offer accepted;
    IF NOT accepted THEN
      ! Of a path nothing is executed then.
      IF path_points > 0 begin_at_rest;
      RETURN;
    ENDIF
    last := point;
    code := SUCCESS;
  ERROR
    RAISE;
  ENDPROC

  ! Joints 1 to 6 are those of the first unit, 7 to 12 those of the second; rad on the wire.
  PROC read_joints(VAR robjoint point{*})
    VAR num values{6};
    VAR num at := 17;
    FOR u FROM 1 TO UNITS DO
      FOR i FROM 1 TO 6 DO
        UnpackRawBytes message, at, values{i} \Float4;
        values{i} := values{i} * DEGREES;
        at := at + 4;
      ENDFOR
      point{u} := [values{1}, values{2}, values{3}, values{4}, values{5}, values{6}];
    ENDFOR
  ENDPROC

  ! A download is checked from point to point, so last follows it.
  PROC collect(VAR robjoint point{*}, num duration)
    VAR num at;
    collected := collected + 1;
    path_durations{collected} := duration;
    FOR u FROM 1 TO UNITS DO
      at := (collected - 1) * UNITS + u;
      path{at} := point{u};
    ENDFOR
    last := point;
  ENDPROC

  FUNC bool is_slow_enough(VAR robjoint point{*}, num duration)
    VAR num most;
    most := MAX_SPEED * duration;
    FOR u FROM 1 TO UNITS DO
      IF NOT is_near(point{u}, last{u}, most) RETURN FALSE;
    ENDFOR
    RETURN TRUE;
  ENDFUNC

  ! Both rendezvous with the motion tasks. They come to the first when their queue has room: back-pressure.
  PROC offer(VAR bool accepted)
    accepted := FALSE;
    WaitSyncTask point_offered, sync_tasks \TimeOut:=ACCEPT_TIMEOUT;
    WaitSyncTask point_copied, sync_tasks \TimeOut:=COPY_TIMEOUT;
    accepted := TRUE;
  ERROR
    IF ERRNO = ERR_WAITSYNCTASK RETURN;
    RAISE;
  ENDPROC

  ! Stop all arms, and let the motion tasks forget their queues.
  ! A task that does not run takes no trap, and its start would go on with the queue: no arm moves before all have answered.
  PROC stop_motion()
    stop_confirmed := FALSE;
    StopMove \AllMotionTasks;
    stop_number := (stop_number + 1) MOD 1000;
    WaitUntil all_have_stopped() \MaxTime:=STOP_TIMEOUT;
    StartMove \AllMotionTasks;
    stop_confirmed := TRUE;
    begin_at_rest;
  ERROR
    IF ERRNO = ERR_WAIT_MAXTIME THEN
      TPWrite "Streaming: a motion task does not run, the arms stay stopped";
      begin_at_rest;
      RETURN;
    ENDIF
    ! Motors off or program stopped since: the arms stay stopped, and the next point stops them anew.
    IF ERRNO = ERR_STARTMOVE RETURN;
    RAISE;
  ENDPROC

  FUNC bool all_have_stopped()
    FOR u FROM 1 TO UNITS DO
      IF stop_done{u} <> stop_number RETURN FALSE;
    ENDFOR
    RETURN TRUE;
  ENDFUNC

  PROC begin_at_rest()
    VAR jointtarget here;
    downloading := FALSE;
    collected := 0;
    FOR u FROM 1 TO UNITS DO
      here := CJointT(\TaskName:=MOTION_TASKS{u});
      last{u} := here.robax;
    ENDFOR
  ENDPROC

ENDMODULE
