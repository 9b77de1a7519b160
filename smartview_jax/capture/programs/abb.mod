MODULE SmartviewCapture
  ! smartview capture: a program for ABB controllers (option 616-1 PC Interface).
  !
  !   PC:     smartview capture FOLDER --robot tcp:192.168.0.10:5000 --format abb
  !   Robot:  this module, started at Main, with the controller's own address below
  !
  ! It answers "pose" with x y z q1 q2 q3 q4 of tool0 in wobj0 (mm), and
  ! "step x y z q1 q2 q3 q4 speed" (mm, mm/s) with "done" after a straight motion.
  ! Not tested on every version: run it at reduced speed first, in manual mode.

  VAR socketdev listener;
  VAR socketdev pc;
  VAR num v{9};

  PROC Main()
    ! Keep the configuration of the wrist: a step is short.
    ConfL\Off;
    SocketCreate listener;
    SocketBind listener, "192.168.0.10", 5000;
    SocketListen listener;
    WHILE TRUE DO
      SocketAccept listener, pc\Time:=WAIT_MAX;
      Serve;
      SocketClose pc;
    ENDWHILE
  ENDPROC

  PROC Serve()
    VAR string line;
    WHILE TRUE DO
      SocketReceive pc\Str:=line\Time:=WAIT_MAX;
      IF StrMatch(line, 1, "pose") = 1 THEN
        SendPose;
      ELSEIF StrMatch(line, 1, "step") = 1 THEN
        ReadNumbers line;
        MakeStep;
        SocketSend pc\Str:="done\0A";
      ELSE
        SocketSend pc\Str:="error unknown line\0A";
      ENDIF
    ENDWHILE
  ERROR
    ! The connection was closed: wait for the next one.
    IF ERRNO = ERR_SOCK_CLOSED THEN
      RETURN;
    ENDIF
  ENDPROC

  PROC SendPose()
    VAR robtarget p;
    p := CRobT(\Tool:=tool0\WObj:=wobj0);
    ! Two messages: a string has at most 80 characters.
    SocketSend pc\Str:="pose " + NumToStr(p.trans.x, 3) + " " + NumToStr(p.trans.y, 3) + " " + NumToStr(p.trans.z, 3);
    SocketSend pc\Str:=" " + NumToStr(p.rot.q1, 6) + " " + NumToStr(p.rot.q2, 6) + " " + NumToStr(p.rot.q3, 6) + " " + NumToStr(p.rot.q4, 6) + "\0A";
  ENDPROC

  PROC ReadNumbers(string line)
    VAR num first;
    VAR num last;
    VAR bool ok;
    first := 6;
    FOR k FROM 1 TO 8 DO
      last := StrFind(line, first, " \0A");
      ok := StrToVal(StrPart(line, first, last - first), v{k});
      first := last + 1;
    ENDFOR
  ENDPROC

  PROC MakeStep()
    VAR robtarget p;
    VAR speeddata speed;
    p := CRobT(\Tool:=tool0\WObj:=wobj0);
    p.trans := [v{1}, v{2}, v{3}];
    p.rot := NOrient([v{4}, v{5}, v{6}, v{7}]);
    speed := [v{8}, 20, 200, 15];
    MoveL p, speed, fine, tool0\WObj:=wobj0;
  ENDPROC
ENDMODULE
